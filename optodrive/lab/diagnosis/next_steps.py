"""Next steps of a user: the experiment that separates two rivals in the least lab time, and the commands to run.

The experiment is sought over a finite grid. The recorded experiments are part of it: more repeats of one may be the
quickest way.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from shlex import join

import numpy as np

from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Discrepancy, NextExperiment
from optodrive.lab.diagnosis.dataset import NEVER_S, PIXEL_KINDS, SIGNALS, Dataset, RunInfo, Samples, assemble_dataset
from optodrive.lab.diagnosis.detection import ProgressCallback
from optodrive.lab.diagnosis.fitting import (
    FitProblem,
    ModelFit,
    compute_jacobian,
    compute_jitter_sensitivity,
    compute_normal_equations,
    solve,
)
from optodrive.lab.diagnosis.model_selection import Selection
from optodrive.lab.diagnosis.noise_model import ColouredNoise
from optodrive.lab.diagnosis.prediction import predict
from optodrive.physics.pixel_ode import PixelExperiment
from optodrive.physics.terms import discover_terms

CERTAIN = 0.95
"""Probability of an explanation that no further experiment needs to confirm."""
MIN_REPEATS, MAX_REPEATS = 3, 30
"""Minimum and maximum number of repeats of an experiment."""
CHI2_SEPARATED = 24.0
"""χ² between rivals that separates them."""
SETUP_S = 2.0
"""Time between two runs."""
SAMPLES = 400
ASSUMED_NOISE = {
    0: ColouredNoise(1.0, (0.3, 0.3), (1e-2, 1.0)),
    1: ColouredNoise(0.5e-6, (0.2e-6, 0.2e-6), (1e-2, 1.0)),
    2: ColouredNoise(0.2e-3, (0.1e-3, 0.1e-3), (1e-2, 1.0)),
}
"""Noise of a signal that was not measured yet, by kind: a thermal camera, an interferometer, a load cell."""
ASSUMED_NOISE_TEXT = {0: "1 K", 1: "0.5 µm", 2: "0.2 mN"}
FRAMES = "frames.json"
OUT = "answer"
"""Folder of the answer, where no other is named."""


def propose_for_verdict(
    problem: FitProblem, base: ModelFit, selection: Selection, on_progress: ProgressCallback
) -> NextExperiment | None:
    """Return the experiment that separates the two most probable models, None if one explanation is certain.

    Of an ambiguity, these are two of its causes; else the nominal model is one of the rivals.
    """
    probabilities = selection.probabilities
    rivals = [(probabilities.causes[tuple(sorted(item.causes))], item.label, item.fit) for item in selection.ranked]
    if selection.claim.verdict == "ambiguous":
        is_named = [set(item.causes) <= set(selection.claim.causes) for item in selection.ranked]
        rivals = rivals[:1] + [rival for rival, named in zip(rivals[1:], is_named[1:], strict=True) if named]
    elif selection.claim.verdict == "cause" or max(probabilities.no_effect, probabilities.none_of_these) >= CERTAIN:
        return None
    else:
        rivals = sorted([(probabilities.no_effect, "no effect", base), *rivals], key=lambda rival: -rival[0])
    if len(rivals) < 2:
        return None
    on_progress("the next experiment")
    (_, first_label, first), (_, second_label, second) = rivals[:2]
    return propose_experiment(problem, first, second, (first_label, second_label))


def propose_experiment(
    problem: FitProblem, first: ModelFit, second: ModelFit, labels: tuple[str, str]
) -> NextExperiment | None:
    """Return the cheapest experiment of the grid that separates two fits, or None if none does.

    Signals that were not measured are proposed in addition, with `ASSUMED_NOISE`, only if the measured ones do not do.
    """
    measured = tuple(kind for kind in problem.data.kinds if kind in PIXEL_KINDS)
    if not measured:
        return None
    best = _search_grid(problem, first, second, labels, measured)
    if best is not None:
        return best
    proposals = []
    for extra in sorted(set(PIXEL_KINDS).difference(measured)):
        noise = replace(
            problem.noise,
            coloured={**problem.noise.coloured, extra: ASSUMED_NOISE[extra]},
            baseline_sigma={**problem.noise.baseline_sigma, extra: ASSUMED_NOISE[extra].white},
        )
        kinds = tuple(sorted((*measured, extra)))
        proposal = _search_grid(replace(problem, noise=noise), first, second, labels, kinds)
        if proposal is not None:
            assumed = f"; needs {SIGNALS[extra]}, measured to {ASSUMED_NOISE_TEXT[extra]}"
            proposals.append(replace(proposal, description=proposal.description + assumed))
    return min(proposals, key=lambda item: item.lab_time_s, default=None)


def _search_grid(
    problem: FitProblem, first: ModelFit, second: ModelFit, labels: tuple[str, str], kinds: tuple[int, ...]
) -> NextExperiment | None:
    """Return the cheapest experiment of the grid, measured in these kinds of signals, that separates two fits."""
    data = problem.data
    pixel = Counter(block.pixel for block in data.blocks if block.kind in PIXEL_KINDS).most_common(1)[0][0]
    best: NextExperiment | None = None
    for description, pulses, span_s in _generate_grid(data, pixel):
        synthetic = _build_synthetic_dataset(pulses, pixel, span_s, kinds)
        separation_per_repeat = _compute_separation(problem, first, second, synthetic, MIN_REPEATS) / MIN_REPEATS
        repeats = max(MIN_REPEATS, ceil(min(CHI2_SEPARATED / max(separation_per_repeat, 1e-9), MAX_REPEATS)))
        separation = _compute_separation(problem, first, second, synthetic, repeats)
        duration_s = repeats * (span_s + SETUP_S)
        if separation < CHI2_SEPARATED / 2 or (best is not None and duration_s >= best.lab_time_s):
            continue
        signals = tuple(SIGNALS[kind] for kind in kinds)
        text = f"{description}, {repeats} times, measured on pixel {pixel}, separates {labels[0]} and {labels[1]}"
        best = NextExperiment(text, pulses, pixel, repeats, signals, separation, duration_s)
    return best


def _generate_grid(data: Dataset, pixel: int) -> Iterator[tuple[str, FloatArray, float]]:
    neighbour = next((pulsed for pulsed in _list_pulsed_pixels(data) if pulsed != pixel), pixel + 1)
    full_power_w = max(experiment.full_w for experiment, _ in data.experiments)
    for power_w in (0.25 * full_power_w, 0.5 * full_power_w, full_power_w):
        for width_s in (0.002, 0.01, 0.05):
            for pulsed in (pixel, neighbour):
                location = "" if pulsed == pixel else f" on neighbouring pixel {pulsed}"
                pulses = np.array([[0.02, width_s, power_w, pulsed]])
                description = (
                    f"one pulse of {format_quantity(width_s, 's')} at {format_quantity(power_w, 'W')}{location}"
                )
                yield description, pulses, 0.02 + width_s + 0.25
        for gap_s in (0.02, 0.06):
            starts = 0.02 + np.arange(0.0, 3.0, 0.02 + gap_s)
            pulses = np.array([[start, 0.02, power_w, pixel] for start in starts])
            yield (
                f"3 s of 20 ms pulses, {format_quantity(gap_s, 's')} apart, at {format_quantity(power_w, 'W')}",
                pulses,
                4.0,
            )
    for group, numbers in data.groups.items():
        recorded = [block for block in data.blocks if block.run == numbers[0] and block.pixel == pixel]
        if recorded:
            span_s = max(float(block.t_s[-1]) for block in recorded)
            yield f"the recorded experiment {group!r} again", data.runs[numbers[0]].pulses, span_s


def _list_pulsed_pixels(data: Dataset) -> list[int]:
    """Return the pulsed pixels, most frequent first."""
    counts = Counter(int(pixel) for run in data.runs for pixel in run.pulses[:, 3])
    return [pixel for pixel, _ in counts.most_common()]


def _build_synthetic_dataset(pulses: FloatArray, pixel: int, span_s: float, kinds: tuple[int, ...]) -> Dataset:
    t_s = np.linspace(span_s / SAMPLES, span_s, SAMPLES)
    first, second, third = (t_s if kind in kinds else NEVER_S for kind in PIXEL_KINDS)
    experiment = PixelExperiment(pulses, pixel, 293.15, (first, second, third), dose_before=1.0, session_time=1.0)
    samples = [Samples(0, kind, pixel, t_s, np.zeros(SAMPLES), t_s) for kind in kinds]
    return assemble_dataset((RunInfo("next", "next", 293.15, pulses, None),), samples, [(0, experiment)])


def _compute_separation(problem: FitProblem, first: ModelFit, second: ModelFit, data: Dataset, repeats: int) -> float:
    """Return χ² between both predictions with the remaining freedom of either model projected out."""
    first_prediction = predict(data, first.point)
    second_prediction = predict(data, second.point)
    sensitivity = compute_jitter_sensitivity(data, first.point, first_prediction)
    synthetic = FitProblem(data, problem.noise, problem.prior)
    first_jacobian = compute_jacobian(synthetic, first.point, first.free, first_prediction)
    second_jacobian = compute_jacobian(synthetic, second.point, second.free, second_prediction)
    columns = np.column_stack([first_jacobian, second_jacobian, first_prediction - second_prediction])
    gram = repeats * compute_normal_equations(data, columns, problem.noise, sensitivity)
    count = columns.shape[1] - 1
    precision = np.zeros((count, count))
    width = first_jacobian.shape[1]
    precision[:width, :width] = solve(first.covariance, np.eye(width))
    precision[width:, width:] = solve(second.covariance, np.eye(count - width))
    cross = gram[:count, -1]
    return float(gram[-1, -1] - cross @ solve(gram[:count, :count] + precision, cross))


@dataclass(frozen=True)
class NextStep:
    """A reason, and the command to run for it, from the folder in which the diagnosis was run."""

    reason: str
    command: str


def list_next_steps(
    discrepancy: Discrepancy, recordings: Sequence[str], out: str = OUT, config: str | None = None
) -> list[NextStep]:
    """Return the steps in their order.

    recordings, out, config: what was diagnosed, the answer's folder and the configuration, as the command named them
    """
    verdict, causes = discrepancy.verdict, discrepancy.causes
    display = () if config is None else ("--config", config)
    model, again = str(Path(out) / "model.toml"), ("--out", f"{out.rstrip('/')}-2", *display)
    more = "the proposed experiment" if discrepancy.next_experiment else "each experiment three times"
    has_model = bool(discrepancy.base) and verdict != "unexplained"
    changes_plans = has_model and any(_changes_plans(key) for key in causes)
    plans = changes_plans or (has_model and verdict in ("none", "instrument"))
    table: list[tuple[bool, str, Sequence[str]]] = [
        (
            verdict == "unexplained",
            "Look at the signals in which the residuals are largest.",
            ("recording", "show", recordings[0], "--out", "signals.png"),
        ),
        (
            verdict in ("ambiguous", "undecided") or bool(discrepancy.doubts),
            f"Record {more}, and diagnose it together with these runs.",
            ("diagnose", *recordings, "more.h5", *again),
        ),
        (
            "mirror_lag" in causes,
            "Identify the mirrors' servos from steps.",
            ("calibrate", "steps", "--out", "steps", *display),
        ),
        (
            "mirror_lag" in causes,
            "Complete the steps by the measured angles; plan with the result (--mirrors).",
            ("calibrate", "servo", "steps", "--out", "mirrors.toml", *display),
        ),
        ("clock_offset" in causes, *_correct_clock(discrepancy, recordings, again)),
        (plans, "Plan heights with this model.", ("plan", FRAMES, "--model", model, *display)),
        (
            changes_plans,
            "See what the effect does to heights planned without it.",
            ("simulate", FRAMES, "--truth", model, *display),
        ),
        (plans, "Serve the display with it.", ("serve", "--model", model, *display)),
    ]
    failed = [label.partition(" ")[0].rstrip(":") for label in discrepancy.failures]
    steps: list[tuple[str, Sequence[str]]] = [
        (f"Correct the term, which could not be computed: {key}.", ("terms", key)) for key in failed
    ]
    steps += [(reason, arguments) for is_due, reason, arguments in table if is_due]
    return [NextStep(reason, join(["optodrive", *arguments])) for reason, arguments in steps]


def _changes_plans(key: str) -> bool:
    """Return whether a term acts in the pixel, rather than in an instrument or in the mirrors."""
    kernels = discover_terms()[key].kernels._replace(sensor_reading=None, sensor_lag=None, force=None)
    return any(hook is not None for hook in kernels)


def _correct_clock(
    discrepancy: Discrepancy, recordings: Sequence[str], again: Sequence[str]
) -> tuple[str, Sequence[str]]:
    """Return the step that corrects the times of all signals when they are merged, or of one before it is."""
    offsets = {name: item.value for name, item in discrepancy.parameters.items() if name.startswith("clock_offset.")}
    name, offset_s = next(iter(offsets.items()), ("", 0.0))
    if len(offsets) > 1:
        files = ("session.h5", "measured", f"--time-offset={-offset_s:.3g}", "--out", "recording.h5")
        reason = "Correct the instrument's times when session and measurement are merged."
        return reason, ("recording", "merge", *files)
    reason = f"Correct the times of {name.partition('.')[2]} by {format_quantity(-offset_s, 's')}, and diagnose again."
    return reason, ("diagnose", *recordings, *again)
