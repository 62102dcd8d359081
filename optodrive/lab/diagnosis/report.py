"""Diagnosis report: one self-contained HTML file built from the same data as the answer."""

from collections.abc import Iterator, Sequence
from html import escape
from math import isfinite

from optodrive.core.html_page import render_page, render_table
from optodrive.core.provenance import Provenance
from optodrive.core.quantity import format_number, format_quantity
from optodrive.core.types.discrepancy import Discrepancy, Probabilities, ResidualTrace
from optodrive.lab.diagnosis.candidate_judgement import DETECTABLE_RATIO
from optodrive.lab.diagnosis.narrative import build_narrative
from optodrive.lab.diagnosis.next_steps import OUT, NextStep, list_next_steps
from optodrive.lab.diagnosis.report_figures import draw_bar, draw_example, draw_residuals, draw_share
from optodrive.lab.diagnosis.search_log import SearchLog
from optodrive.lab.inference.claim import format_probability
from optodrive.lab.inference.sentences import MIN_SHOWN
from optodrive.lab.inspection.page import build_section

MAX_TRACES = 12
NAMED = ("identified", "indistinguishable")
MEASURED = "<span class='key measured'>measured</span>"
NOMINAL = "<span class='key nominal'>nominal model, refitted</span>"
EXTENDED = "<span class='key extended'>extended model</span>"


def build_report(
    discrepancy: Discrepancy,
    title: str,
    provenance: Provenance | None = None,
    recordings: Sequence[str] = ("recording.h5",),
    out: str = OUT,
    config: str | None = None,
    sections: Sequence[str] = (),
) -> str:
    """Return the report as HTML.

    recordings, out, config: what was diagnosed, the report's folder and the configuration, as the command named them;
    sections: HTML that follows the probabilities
    """
    has_extension = bool(discrepancy.terms)
    steps = SearchLog().attempt("next steps", list_next_steps, list[NextStep](), discrepancy, recordings, out, config)
    models = f"{NOMINAL}, {EXTENDED}" if has_extension else NOMINAL
    parts = [
        *_build_next_steps(steps),
        *_build_probabilities(discrepancy.probabilities),
        *sections,
        "<h2>Measured against model</h2>",
        f"<p>{MEASURED}, {models}. The nominal model has the R, C, τ<sub>g</sub>, κ and φ that fit these data best, "
        "not those of a parameter set. Of each signal the run in which it is worst, and the median one; below, "
        "measured minus model. The band is the noise of one sample, ± σ.</p>",
        "<div class='grid'>",
        *(draw_example(example, has_extension) for example in discrepancy.example_traces),
        "</div>",
        *_build_height_errors(discrepancy, has_extension),
        *_build_held_out(discrepancy, models, has_extension),
        "<h2>Evidence for each cause</h2>",
        f"<p>Likelihood ratio against the nominal model, on a logarithmic scale. The dashed line is at "
        f"{DETECTABLE_RATIO:g}: an effect of this ratio is detected nine times in ten.</p>",
        _build_evidence_table(discrepancy),
        *_build_rivals(discrepancy),
        "<h2>Parameters</h2>",
        _build_parameter_table(discrepancy),
        "<h2>Residuals by experiment</h2>",
        f"<p>{models}; measured minus model in the first run of the groups with the largest residuals.</p>",
        "<div class='grid'>",
        *(draw_residuals(trace, has_extension) for trace in _select_traces(discrepancy.residual_traces)),
        "</div>",
    ]
    data = [*build_section(discrepancy.data_findings, discrepancy.inspection_failures), "<h2>The answer</h2>"]
    return render_page(title, discrepancy.verdict, build_narrative(discrepancy), parts, provenance, data)


def _build_probabilities(probabilities: Probabilities) -> list[str]:
    """Return the section with the probability of every explanation above `MIN_SHOWN`, most probable first."""
    rows = [(" with ".join(keys), value) for keys, value in probabilities.causes.items() if value >= MIN_SHOWN]
    rows += [("none of these causes", probabilities.none_of_these), ("no effect", probabilities.no_effect)]
    cells = [
        (escape(name), draw_share(value), format_probability(value))
        for name, value in sorted(rows, key=lambda row: -row[1])
    ]
    return [
        "<h2>Probabilities</h2>",
        "<p>Of each cause alone, of causes that act together, of a cause that is in no catalogue, and of no effect, or "
        "none that this recording could show. They sum to one; what has less than "
        f"{format_probability(MIN_SHOWN)} is not listed.</p>",
        render_table(("explanation", "diagram", "probability"), cells, frozenset({2}), "Probabilities"),
    ]


def _build_next_steps(steps: list[NextStep]) -> Iterator[str]:
    """Return the section with the commands to run next."""
    if not steps:
        return
    yield "<h2>Run next</h2>"
    yield "<p>From the folder in which <code>diagnose</code> was run; frames.json and more recordings are your own.</p>"
    rows = ((escape(step.reason), f"<code>{escape(step.command)}</code>") for step in steps)
    yield render_table(("why", "command"), rows, label="Run next")


def _select_traces(traces: tuple[ResidualTrace, ...]) -> list[ResidualTrace]:
    return sorted(traces, key=lambda item: -float((item.nominal**2).mean()))[:MAX_TRACES]


def _build_height_errors(discrepancy: Discrepancy, has_extension: bool) -> Iterator[str]:
    """Return the section on heights: the errors of plans made with either model, on recorded pushes."""
    errors = (("held out of the fit", discrepancy.height_error_held_out), ("all", discrepancy.height_error_fitted))
    yield "<h2>Error of planned heights</h2>"
    if discrepancy.height_error_fitted is None:
        yield "<p>Unknown: no measured push is clear of the noise.</p>"
        return
    yield (
        "<p>Measured height against the height for which the model would have chosen the recorded drive. Pushes unlike "
        "the recorded ones may be further off.</p>"
    )
    rows = (
        (
            *(name, str(error.pushes), str(error.experiments), f"{error.nominal_rms:.1%}", f"{error.nominal_max:.1%}"),
            *((f"{error.extended_rms:.1%}", f"{error.extended_max:.1%}") if has_extension else ()),
            f"{error.noise:.1%}",
        )
        for name, error in errors
        if error is not None
    )
    extended = ("extended, rms", "largest") if has_extension else ()
    header = ("pushes", "number", "experiments", "nominal, rms", "largest", *extended, "noise")
    yield render_table(header, rows, frozenset(range(1, len(header))), "Error of planned heights")


def _build_held_out(discrepancy: Discrepancy, models: str, has_extension: bool) -> Iterator[str]:
    """Return the section on held-out groups: the errors of both models, which did not see them, and the residuals."""
    yield "<h2>Held-out groups</h2>"
    if not discrepancy.held_out_errors:
        yield (
            "<p>No group was held out: every kind of experiment has fewer than three groups, or the effect shows in "
            "the held-out ones alone, which were then fitted too.</p>"
        )
        return
    yield "<p>RMSE of models that were fitted without these groups, and the RMSE that noise alone would give.</p>"
    rows = []
    for item in discrepancy.held_out_errors:
        unit = item.signal.rsplit("_", 1)[1]
        values = [item.nominal, *([item.extended] if has_extension else []), item.noise_floor]
        cells = (format_quantity(value, unit) for value in values)
        rows.append((escape(item.group), escape(item.signal), str(item.runs), *cells))
    header = ("group", "signal", "runs", "before", *(["after the extension"] if has_extension else []), "noise")
    yield render_table(header, rows, frozenset(range(2, len(header))), "Held-out groups")
    yield f"<p>{models}</p><div class='grid'>"
    yield from (draw_residuals(trace, has_extension) for trace in _select_traces(discrepancy.held_out_traces))
    yield "</div>"


def _build_evidence_table(discrepancy: Discrepancy) -> str:
    strongest = sorted(discrepancy.candidates, key=lambda item: -item.statistic)
    max_ratio = max((item.statistic for item in strongest if isfinite(item.statistic)), default=0.0)
    rows = (
        (
            escape(item.label),
            draw_bar(min(item.statistic, max_ratio), max_ratio, DETECTABLE_RATIO, item.verdict in NAMED),
            format_number(item.statistic),
            format_probability(item.probability),
            _format_gain(item.heldout_gain),
            f"<span class='nowrap'>{escape(item.verdict)}</span>",
            f"<span class='nowrap'>{escape(item.detection_limit)}</span>",
        )
        for item in strongest
    )
    header = (
        "cause",
        "likelihood ratio",
        "ratio",
        "probability",
        "held-out gain",
        "verdict",
        "smallest visible effect",
    )
    return render_table(header, rows, frozenset({2, 3, 4}), "Evidence for each cause")


def _build_rivals(discrepancy: Discrepancy) -> list[str]:
    if not discrepancy.rivals:
        return []
    rows = (
        (
            escape(item.label),
            f"{item.chi2:+.0f}",
            f"{item.log_evidence:.1f}".replace("-", "−"),
            format_probability(item.probability),
            _format_gain(item.heldout_gain),
            "<br>".join(
                f"{escape(name)} = {escape(format_quantity(value, unit))}"
                for name, (value, unit) in item.parameters.items()
            ),
        )
        for item in discrepancy.rivals
    )
    chosen = frozenset(number for number, item in enumerate(discrepancy.rivals) if item.is_chosen)
    return [
        "<h3>Rivals, refitted</h3>",
        "<p>χ² above the best rival's, logarithm of the marginal likelihood below the best one's, and the probability "
        "of exactly these causes, which counts other forms of their effect too; bold: the model of later steps.</p>",
        render_table(
            ("causes", "χ²", "log evidence", "probability", "held-out gain", "parameters"),
            rows,
            frozenset({1, 2, 3, 4}),
            "Rivals",
            chosen,
        ),
    ]


def _format_gain(gain: float | None) -> str:
    return "" if gain is None else f"{gain:.0%}".replace("-", "−")


def _build_parameter_table(discrepancy: Discrepancy) -> str:
    rows = (
        (escape(name), format_quantity(item.value, item.unit), "limit of the range, no estimate", "")
        if item.at_limit
        else (escape(name), *(format_quantity(value, item.unit) for value in (item.value, item.low, item.high)))
        for name, item in discrepancy.parameters.items()
    )
    return render_table(("parameter", "value", "95 % from", "to"), rows, frozenset({1, 2, 3}), "Parameters")
