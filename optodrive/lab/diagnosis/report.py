"""Diagnosis report: one self-contained HTML file built from the same data as the answer.

It shows what the narrative states: what to run next, the probabilities, measured values beside the nominal and the
extended model, their errors on planned heights and on held-out groups, and the evidence for each cause.
"""

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from math import isfinite, log10

import numpy as np

from optodrive.core.document import Document, Figure, Markup, Section, Table
from optodrive.core.provenance import Provenance
from optodrive.core.quantity import format_number, format_quantity
from optodrive.core.svg_plot import Axis, Series, draw_plot
from optodrive.core.types.discrepancy import Discrepancy, Probabilities, ResidualTrace
from optodrive.lab.diagnosis.candidate_judgement import DETECTABLE_RATIO
from optodrive.lab.diagnosis.detection import SearchLog
from optodrive.lab.diagnosis.narrative import build_narrative
from optodrive.lab.diagnosis.next_steps import OUT, NextStep, list_next_steps
from optodrive.lab.inference.claim import format_probability
from optodrive.lab.inference.sentences import MIN_SHOWN
from optodrive.lab.inspection.page import build_section

MAX_TRACES = 12
NAMED = ("identified", "indistinguishable")
MEASURED = "<span class='key measured'>measured</span>"
NOMINAL = "<span class='key nominal'>nominal model, refitted</span>"
EXTENDED = "<span class='key extended'>extended model</span>"
QUANTITIES = {
    "absorber_temperature_K": "absorber above ambient",
    "displacement_m": "displacement",
    "force_N": "force",
    "mirror_x_rad": "mirror x",
    "mirror_y_rad": "mirror y",
}
TIME = Axis("time", "s")
TRACE_HEIGHT, RESIDUAL_HEIGHT = 230, 150
BAR_WIDTH, BAR_HEIGHT = 220, 26


def build_report(
    discrepancy: Discrepancy,
    title: str,
    provenance: Provenance | None = None,
    recordings: Sequence[str] = ("recording.h5",),
    out: str = OUT,
    config: str | None = None,
    sections: Sequence[Section] = (),
) -> str:
    """Return the report as HTML.

    recordings, out, config: what was diagnosed, the report's folder and the configuration, as the command named them;
    sections: those that follow the probabilities
    """
    has_extension = bool(discrepancy.terms)
    models = f"{NOMINAL}, {EXTENDED}" if has_extension else NOMINAL
    steps = SearchLog().attempt("next steps", list_next_steps, list[NextStep](), discrepancy, recordings, out, config)
    data = build_section(discrepancy.data_findings, discrepancy.inspection_failures)
    body: list[Section | Markup] = [
        *_build_next_steps(steps),
        _build_probabilities(discrepancy.probabilities),
        *sections,
        Section(
            "Measured against model",
            [
                Markup(
                    f"<p>{MEASURED}, {models}. The nominal model has the R, C, τ<sub>g</sub>, κ and φ that fit these "
                    "data best, not those of a parameter set. Of each signal the experiment in which it is worst, and "
                    "the median one; below, measured minus model. The band is the noise of one sample, ± σ.</p>"
                ),
                _draw_examples(discrepancy.residual_traces, has_extension),
            ],
        ),
        Section("Error of planned heights", _build_height_errors(discrepancy, has_extension)),
        Section("Held-out groups", _build_held_out(discrepancy, models, has_extension)),
        Section(
            "Evidence for each cause",
            [
                "Likelihood ratio against the nominal model, on a logarithmic scale. The dashed line is at "
                f"{DETECTABLE_RATIO:g}: an effect of this ratio is detected nine times in ten.",
                _build_evidence_table(discrepancy),
            ],
        ),
        *_build_rivals(discrepancy),
        Section("Parameters", [_build_parameter_table(discrepancy)]),
        Section(
            "Residuals by experiment",
            [
                Markup(
                    f"<p>{models}; measured minus model in the first run of the groups with the largest residuals.</p>"
                ),
                _draw_worst(discrepancy.residual_traces, has_extension),
            ],
        ),
    ]
    opening = [data, Section("The answer", ())]
    return Document(title, discrepancy.verdict, build_narrative(discrepancy), body, provenance, opening).to_html()


def _build_probabilities(probabilities: Probabilities) -> Section:
    """Return the section with the probability of every explanation above `MIN_SHOWN`, most probable first."""
    rows = [(" with ".join(keys), value) for keys, value in probabilities.causes.items() if value >= MIN_SHOWN]
    rows += [("none of these causes", probabilities.none_of_these), ("no effect", probabilities.no_effect)]
    cells = [
        (name, draw_share(value), format_probability(value)) for name, value in sorted(rows, key=lambda row: -row[1])
    ]
    text = (
        "Of each cause alone, of causes that act together, of a cause that is in no catalogue, and of no effect, or "
        "none that this recording could show. They sum to one; what has less than "
        f"{format_probability(MIN_SHOWN)} is not listed."
    )
    table = Table("Probabilities", ("explanation", "diagram", "probability"), cells, {2})
    return Section("Probabilities", [text, table])


def _build_next_steps(steps: list[NextStep]) -> list[Section]:
    """Return the section with the commands to run next, if there are any."""
    text = (
        "<p>From the folder in which <code>diagnose</code> was run; frames.json and more recordings are your own.</p>"
    )
    rows = [(step.reason, Markup(f"<code>{escape(step.command)}</code>")) for step in steps]
    return [Section("Run next", [Markup(text), Table("Run next", ("why", "command"), rows)])] if steps else []


def _draw_worst(traces: tuple[ResidualTrace, ...], has_extension: bool) -> list[Figure]:
    worst = sorted(traces, key=lambda item: -float((item.nominal**2).mean()))[:MAX_TRACES]
    return [draw_residuals(trace, has_extension) for trace in worst]


def _build_height_errors(discrepancy: Discrepancy, has_extension: bool) -> Iterator[str | Table]:
    """Return the errors of plans made with either model, on recorded pushes."""
    errors = (("held out of the fit", discrepancy.height_error_held_out), ("all", discrepancy.height_error_fitted))
    if discrepancy.height_error_fitted is None:
        yield "Unknown: no measured push is clear of the noise."
        return
    yield (
        "Measured height against the height for which the model would have chosen the recorded drive. Pushes unlike "
        "the recorded ones may be further off."
    )
    extended, header = ("extended, rms", "largest"), ["pushes", "number", "experiments", "nominal, rms", "largest"]
    rows = []
    for name, error in errors:
        if error is not None:
            shares = [error.nominal_rms, error.nominal_max, error.extended_rms, error.extended_max, error.noise]
            shares = shares if has_extension else [*shares[:2], error.noise]
            rows.append((name, str(error.pushes), str(error.experiments), *(f"{share:.1%}" for share in shares)))
    header += [*(extended if has_extension else ()), "noise"]
    yield Table("Error of planned heights", header, rows, range(1, len(header)))


def _build_held_out(
    discrepancy: Discrepancy, models: str, has_extension: bool
) -> Iterator[str | Table | Sequence[Figure]]:
    """Return the errors of both models on groups that they did not see, and the residuals."""
    if not discrepancy.held_out_errors:
        yield (
            "No group was held out: every kind of experiment has fewer than three groups, or the effect shows in "
            "the held-out ones alone, which were then fitted too."
        )
        return
    yield "RMSE of models that were fitted without these groups, and the RMSE that noise alone would give."
    rows = []
    for item in discrepancy.held_out_errors:
        unit = item.signal.rsplit("_", 1)[1]
        values = [item.nominal, *([item.extended] if has_extension else []), item.noise_floor]
        rows.append((item.group, item.signal, str(item.runs), *(format_quantity(value, unit) for value in values)))
    header = ("group", "signal", "runs", "before", *(["after the extension"] if has_extension else []), "noise")
    yield Table("Held-out groups", header, rows, range(2, len(header)))
    yield Markup(f"<p>{models}</p>")
    yield _draw_worst(discrepancy.held_out_traces, has_extension)


def _build_evidence_table(discrepancy: Discrepancy) -> Table:
    strongest = sorted(discrepancy.candidates, key=lambda item: -item.statistic)
    max_ratio = max((item.statistic for item in strongest if isfinite(item.statistic)), default=0.0)
    rows = (
        (
            item.label,
            draw_bar(min(item.statistic, max_ratio), max_ratio, DETECTABLE_RATIO, item.verdict in NAMED),
            format_number(item.statistic),
            format_probability(item.probability),
            _format_gain(item.heldout_gain),
            *(Markup(f"<span class='nowrap'>{escape(text)}</span>") for text in (item.verdict, item.detection_limit)),
        )
        for item in strongest
    )
    header = "cause", "likelihood ratio", "ratio", "probability", "held-out gain", "verdict", "smallest visible effect"
    return Table("Evidence for each cause", header, rows, {2, 3, 4})


def _build_rivals(discrepancy: Discrepancy) -> list[Section]:
    if not discrepancy.rivals:
        return []
    rows = [
        (
            item.label,
            f"{item.chi2:+.0f}",
            f"{item.log_evidence:.1f}".replace("-", "−"),
            format_probability(item.probability),
            _format_gain(item.heldout_gain),
            _stack(f"{name} = {format_quantity(value, unit)}" for name, (value, unit) in item.parameters.items()),
        )
        for item in discrepancy.rivals
    ]
    text = (
        "χ² above the best rival's, logarithm of the marginal likelihood below the best one's, and the probability "
        "of exactly these causes, which counts other forms of their effect too; bold: the model of later steps."
    )
    header = "causes", "χ²", "log evidence", "probability", "held-out gain", "parameters"
    chosen = [number for number, item in enumerate(discrepancy.rivals) if item.is_chosen]
    return [Section("Rivals, refitted", [text, Table("Rivals", header, rows, range(1, 5), chosen)], level=3)]


def _stack(lines: Iterable[str]) -> Markup:
    """Return the lines of one cell below each other."""
    return Markup("<br>".join(map(escape, lines)))


def _format_gain(gain: float | None) -> str:
    return "" if gain is None else f"{gain:.0%}".replace("-", "−")


def _build_parameter_table(discrepancy: Discrepancy) -> Table:
    rows = (
        (name, format_quantity(item.value, item.unit), "limit of the range, no estimate", "")
        if item.at_limit
        else (name, *(format_quantity(value, item.unit) for value in (item.value, item.low, item.high)))
        for name, item in discrepancy.parameters.items()
    )
    return Table("Parameters", ("parameter", "value", "95 % from", "to"), rows, {1, 2, 3})


def _draw_examples(traces: Sequence[ResidualTrace], has_extension: bool) -> list[Figure]:
    """Draw the worst and the median trace of each signal. Of a single one draw the worst only."""
    drawn = []
    for signal in dict.fromkeys(trace.signal for trace in traces):
        ranked = sorted((trace for trace in traces if trace.signal == signal), key=lambda trace: -trace.rms_nominal)
        drawn.append(_draw_example("worst", ranked[0], has_extension))
        if len(ranked) > 1:
            drawn.append(_draw_example("typical", ranked[len(ranked) // 2], has_extension))
    return drawn


def _draw_example(role: str, trace: ResidualTrace, has_extension: bool) -> Figure:
    """Draw a run's measured values with the models, and below them the residuals."""
    unit = trace.signal.rsplit("_", 1)[1]
    title = f"{role} run of {trace.signal}: {trace.run}"
    series = [
        Series(trace.measured, "measured", is_dotted=True),
        Series(trace.compute_model(trace.nominal), "nominal"),
        *([Series(trace.compute_model(trace.extended), "extended")] if has_extension else []),
    ]
    axis = Axis(QUANTITIES.get(trace.signal, trace.signal), unit)
    plot = draw_plot(f"{title}, measured and model", trace.t_s, TIME, axis, series, TRACE_HEIGHT)
    return Figure(
        plot + draw_residual_plot(trace, has_extension, title),
        f"{role.capitalize()} run of {trace.signal}: {trace.run} ({trace.group}); the nominal model is "
        f"{trace.rms_nominal:.1f} σ rms off, σ = {format_quantity(trace.sigma, unit)}",
    )


def draw_residuals(trace: ResidualTrace, has_extension: bool) -> Figure:
    """Draw the residuals of a group."""
    nominal, extended = (float(np.sqrt(np.mean(values**2))) for values in (trace.nominal, trace.extended))
    caption = f"{trace.signal}, {trace.group}: nominal {nominal:.1f} σ rms"
    caption += f", extended {extended:.1f} σ" if has_extension else ""
    return Figure(draw_residual_plot(trace, has_extension, f"{trace.signal} of {trace.group}"), caption)


def draw_residual_plot(trace: ResidualTrace, has_extension: bool, title: str) -> str:
    """Draw measured minus model over time, with a band of one σ of the noise on either side of zero."""
    axis = Axis("measured − model", trace.signal.rsplit("_", 1)[1], trace.sigma)
    series = [Series(trace.sigma * trace.nominal, "nominal")]
    if has_extension:
        series.append(Series(trace.sigma * trace.extended, "extended"))
    return draw_plot(f"{title}, residuals", trace.t_s, TIME, axis, series, RESIDUAL_HEIGHT)


def draw_bar(ratio: float, max_ratio: float, threshold: float, is_named: bool) -> Markup:
    """Draw a likelihood ratio as a bar on a logarithmic scale, with a line at the threshold."""
    scale = (BAR_WIDTH - 2) / log10(1.0 + max(max_ratio, 2.0 * threshold))
    width, line = (scale * log10(1.0 + max(0.0, value)) for value in (ratio, threshold))
    threshold_line = f"<line class='threshold' x1='{line:.1f}' x2='{line:.1f}' y1='0' y2='{BAR_HEIGHT}'/>"
    return _draw_horizontal_bar("bar" if is_named else "other", width, threshold_line)


def draw_share(share: float) -> Markup:
    """Draw a share of one as a bar."""
    return _draw_horizontal_bar("bar", share * BAR_WIDTH)


def _draw_horizontal_bar(css_class: str, width: float, more: str = "") -> Markup:
    return Markup(
        f"<svg class='bars' viewBox='0 0 {BAR_WIDTH} {BAR_HEIGHT}' style='width:{BAR_WIDTH}px' aria-hidden='true'>"
        f"<rect class='{css_class}' x='0' y='7' width='{width:.1f}' height='12'/>{more}</svg>"
    )
