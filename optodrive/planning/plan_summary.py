"""The summary of a planned sequence, and plan.csv."""

import csv
from itertools import pairwise
from pathlib import Path

import numpy as np

from optodrive.core.files import atomic_write
from optodrive.core.quantity import format_quantity, list_names, m_to_um
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.report import FeasibilityReport
from optodrive.planning.planned_sequence import PlannedSequence, Shortfall, TrainPeaks, describe_lateness
from optodrive.planning.summary_schema import (
    CyclePeak,
    DeadPixelSummary,
    DelaySummary,
    FrameSummary,
    OffTargetSummary,
    OffTargetTrain,
    PixelIntervals,
    PlanSummary,
    RedrawnSummary,
    RepeatSummary,
    ShortfallSummary,
    SimultaneitySummary,
    SkippedTarget,
    TrimmedPulse,
    TrimmingSummary,
)

DEAD_LISTED_MAX = 20
TRIMMED_LISTED_MAX = 20
INTERVALS_LISTED_MAX, INTERVAL_TOLERANCE = 20, 0.05
"""Pixels listed; difference between two pulses' time and that of their frames, in periods, that is reported."""
TRAINS_LISTED_MAX, PEAKS_LISTED_MAX, PEAKS_NAMED_MAX = 20, 20, 4
PEAK_TOLERANCE = 0.02
"""Relative difference between a peak and the target of its train above which a plan reports it."""
SKIP_REASON = "the residual heat of the pixel reaches the target without a pulse"


def summarize_plan(
    planned: PlannedSequence, feasibility: FeasibilityReport | None = None, pulsed_s: FloatArray | None = None
) -> PlanSummary:
    """Summarize timing, energy, predicted displacement and the limiter's changes.

    pulsed_s: of a streamed frame, time of the plan of each pixel's last pulse before it, −infinity without one, [p]
    """
    plan = planned.plan
    beam_on_s = float(plan.width_s[plan.power_w > 0].sum())
    target_m = np.nan_to_num(plan.target_m)
    max_row = int(np.argmax(planned.predicted_m)) if len(plan) else None
    return PlanSummary(
        feasibility=feasibility,
        pulses=len(plan),
        duration_s=planned.duration_s,
        beam_on_s=beam_on_s,
        beam_on_fraction=beam_on_s / (planned.duration_s * planned.stage_count) if len(plan) else 0.0,
        settling_s=float(plan.settling_s.sum()),
        lead_in_s=planned.lead_in_s,
        galvo_pause_s=planned.galvo_pause_s,
        early_step_s=planned.early_step_s,
        energy_j=float(plan.energy_j.sum()),
        predicted_max_pixel=None if max_row is None else int(plan.pixel[max_row]),
        predicted_max_um=0.0 if max_row is None else m_to_um(float(planned.predicted_m[max_row])),
        predicted_max_target_um=None if max_row is None else _finite_or_none(m_to_um(float(plan.target_m[max_row]))),
        target_max_um=m_to_um(float(target_m.max())) if len(plan) else 0.0,
        headroom_min_k=float(plan.headroom_k.min()),
        trimmed=_summarize_trimming(planned),
        shortfall=None if planned.shortfall is None else _summarize_shortfall(planned.shortfall),
        off_target=_summarize_train_peaks(planned),
        repeats=_summarize_repeats(planned),
        redrawn=None if pulsed_s is None else _summarize_redrawn(planned, pulsed_s),
        delays=[DelaySummary.from_object(each, source=_name_source(planned, each.source)) for each in planned.delays],
        dead=DeadPixelSummary(
            pixels=list(planned.dead_pixels),
            count=len(planned.dead_pixels),
            message=describe_dead_pixels(planned.dead_pixels),
        ),
        skipped=[
            SkippedTarget(
                frame=_name_source(planned, item.source),
                pixel=item.pixel,
                target_um=m_to_um(item.target_m),
                reason=SKIP_REASON,
            )
            for item in planned.skipped
        ],
        frames=_summarize_frames(planned),
        # A frame that waited for a cap, or follows one that did, is late for that reason and not for lack of beam time.
        late_messages=[
            describe_lateness(timing) for timing in planned.frames if timing.late_s > 0 and not planned.delays
        ],
        train_lateness_max_s=planned.train_lateness_max_s,
    )


def describe_dead_pixels(dead: tuple[int, ...]) -> str | None:
    """Describe which dead pixels are omitted. Return None if there are none."""
    if not dead:
        return None
    if len(dead) == 1:
        return f"pixel {dead[0]} is dead: omitted"
    if len(dead) > DEAD_LISTED_MAX:
        listed = list_names(dead, DEAD_LISTED_MAX)
    else:
        listed = f"{', '.join(map(str, dead[:-1]))} and {dead[-1]}"
    return f"pixels {listed} are dead: omitted"


def _summarize_shortfall(shortfall: Shortfall) -> ShortfallSummary:
    return ShortfallSummary.from_object(shortfall, fits_after_s=_finite_or_none(shortfall.fits_after_s))


def _summarize_frames(planned: PlannedSequence) -> list[FrameSummary]:
    simultaneous = {item.source: SimultaneitySummary.from_object(item) for item in planned.simultaneous}
    return [
        FrameSummary.from_object(timing, frame=timing.frame_id, simultaneous=simultaneous.get(timing.source))
        for timing in planned.frames
    ]


def _name_source(planned: PlannedSequence, source: int) -> str:
    frames = planned.sequence.frames
    return frames[source].frame_id if source < len(frames) else f"train {source - len(frames)}"


def _summarize_trimming(planned: PlannedSequence) -> TrimmingSummary:
    plan = planned.plan
    rows = np.flatnonzero(plan.reason != "")
    reasons, counts = np.unique(plan.reason[rows], return_counts=True)
    worst = rows[np.argsort(-plan.trimmed_j[rows], kind="stable")[:TRIMMED_LISTED_MAX]]
    return TrimmingSummary(
        pulses=len(rows),
        energy_j=float(plan.trimmed_j.sum()),
        by_reason={str(reason): int(count) for reason, count in zip(reasons, counts, strict=True)},
        worst=[
            TrimmedPulse(
                pixel=int(plan.pixel[row]),
                start_s=float(plan.start_s[row]),
                trimmed_j=float(plan.trimmed_j[row]),
                reason=str(plan.reason[row]),
                predicted_um=m_to_um(float(planned.predicted_m[row])),
                target_um=_finite_or_none(m_to_um(float(plan.target_m[row]))),
            )
            for row in worst
        ],
    )


def _summarize_train_peaks(planned: PlannedSequence) -> OffTargetSummary:
    off_target = [
        (each, cycles)
        for each in planned.train_peaks
        if len(cycles := np.flatnonzero(np.abs(each.peak_m / each.target_m - 1.0) > PEAK_TOLERANCE))
    ]
    return OffTargetSummary(
        count=len(off_target),
        trains=[
            _summarize_off_target(each, cycles, _name_source(planned, each.source))
            for each, cycles in off_target[:TRAINS_LISTED_MAX]
        ],
    )


def _summarize_off_target(train: TrainPeaks, cycles: IntArray, name: str) -> OffTargetTrain:
    peaks_um, target_um = m_to_um(train.peak_m[cycles]), m_to_um(train.target_m)
    min_um, max_um = float(peaks_um.min()), float(peaks_um.max())
    verb = "differs" if len(cycles) == 1 else "differ"
    named = [f"{peak_um:.1f} µm in cycle {cycle + 1}" for peak_um, cycle in zip(peaks_um, cycles, strict=True)]
    if len(named) > PEAKS_NAMED_MAX:
        named = [*named[: PEAKS_NAMED_MAX - 1], f"… {min_um:.1f} to {max_um:.1f} µm in all"]
    return OffTargetTrain(
        train=name,
        pixel=train.pixel,
        target_um=target_um,
        cycles=len(train.peak_m),
        off_target=len(cycles),
        min_um=min_um,
        max_um=max_um,
        peaks=[
            CyclePeak(cycle=int(cycle) + 1, peak_um=float(peak_um))
            for cycle, peak_um in zip(cycles[:PEAKS_LISTED_MAX], peaks_um, strict=False)
        ],
        message=f"{len(cycles)} of {len(train.peak_m)} peaks of {name} {verb} from {target_um:.4g} µm by more than "
        f"{100 * PEAK_TOLERANCE:.0f} %: {', '.join(named)}",
    )


def _summarize_repeats(planned: PlannedSequence) -> RepeatSummary | None:
    plan, frames = planned.plan, planned.sequence.frames
    is_repeated = [np.array_equal(frame.target_m > 0.0, before.target_m > 0.0) for before, frame in pairwise(frames)]
    if not any(is_repeated):
        return None
    group, show_at_s = np.cumsum([0, *np.logical_not(is_repeated)]), np.array([frame.show_at_s for frame in frames])
    rows = np.flatnonzero(plan.source < len(frames))
    _, first = np.unique(np.stack([plan.pixel[rows], plan.source[rows]]), axis=1, return_index=True)
    rows = rows[first]  # the first pulse of each pixel in each frame, by pixel, in order of the frames
    pixel, source = plan.pixel[rows], plan.source[rows]
    follows = (np.diff(pixel) == 0) & (np.diff(group[source]) == 0)
    if not follows.any():
        return None
    pixel, interval_s = pixel[1:][follows], np.diff(plan.start_s[rows])[follows]
    requested_s = np.diff(show_at_s[source])[follows]
    period_s = requested_s / np.diff(source)[follows]
    difference = np.abs(interval_s - requested_s) / period_s
    order = np.lexsort((-difference, pixel))
    pixels, begin = np.unique(pixel[order], return_index=True)
    min_s, max_s = np.minimum.reduceat(interval_s[order], begin), np.maximum.reduceat(interval_s[order], begin)
    largest, period_s = difference[order][begin], period_s[order][begin]
    off = np.flatnonzero(largest > INTERVAL_TOLERANCE)
    worst = [
        PixelIntervals(pixel=int(pixels[k]), period_s=float(period_s[k]), min_s=float(min_s[k]), max_s=float(max_s[k]))
        for k in off[np.argsort(-largest[off], kind="stable")][:INTERVALS_LISTED_MAX]
    ]
    return RepeatSummary(
        pixels=len(pixels),
        min_s=float(interval_s.min()),
        max_s=float(interval_s.max()),
        off_period=len(off),
        worst=worst,
        message=_describe_intervals(worst[0], len(off), len(pixels)) if worst else None,
    )


def _describe_intervals(worst: PixelIntervals, off: int, pixels: int) -> str:
    kept = "does not keep" if off == 1 else "do not keep"
    return (
        f"{off} of {pixels} pixels {kept} the period of their frames to {100 * INTERVAL_TOLERANCE:.0f} %: pixel "
        f"{worst.pixel} is drawn after {format_quantity(worst.min_s, 's')} to {format_quantity(worst.max_s, 's')} "
        f"instead of {format_quantity(worst.period_s, 's')}"
    )


def _summarize_redrawn(planned: PlannedSequence, pulsed_s: FloatArray) -> RedrawnSummary | None:
    pixels, first = np.unique(planned.plan.pixel, return_index=True)
    since_s = planned.plan.start_s[first] - pulsed_s[pixels]
    since_s = since_s[np.isfinite(since_s)]
    if not len(since_s):
        return None
    return RedrawnSummary(pixels=len(since_s), min_s=float(since_s.min()), max_s=float(since_s.max()))


def _finite_or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


PLAN_COLUMNS = (
    "start_s",
    "width_s",
    "power_w",
    "pixel",
    "x_m",
    "y_m",
    "x_rad",
    "y_rad",
    "energy_j",
    "trimmed_j",
    "reason",
    "predicted_um",
    "stage",
)


def write_plan_csv(path: Path, planned: PlannedSequence, display: DisplayModel) -> None:
    """Write plan.csv atomically, one row a pulse in order."""
    plan = planned.plan
    aims_m = zip(*((head.layout.x_m, head.layout.y_m) for head in display.scan_heads), strict=True)
    rows = zip(
        plan.start_s.tolist(),
        plan.width_s.tolist(),
        plan.power_w.tolist(),
        plan.pixel.tolist(),
        *(np.stack(positions)[plan.stage, plan.pixel].tolist() for positions in aims_m),
        plan.x_rad.tolist(),
        plan.y_rad.tolist(),
        plan.energy_j.tolist(),
        plan.trimmed_j.tolist(),
        plan.reason.tolist(),
        m_to_um(planned.predicted_m).tolist(),
        plan.stage.tolist(),
        strict=True,
    )
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(PLAN_COLUMNS)
        writer.writerows([_round_number(value) for value in row] for row in rows)


def _round_number(value: float | int | str) -> float | int | str:
    return float(f"{value:.12g}") if isinstance(value, float) else value
