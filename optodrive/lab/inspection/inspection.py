"""First page about a recording, before any physics.

`inspect_recording` returns the findings, and the recording without the samples and signals that cannot be used. Every
step sees the recording as the steps before it left it. A step that fails is listed, and takes nothing along.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.plausibility import RECORDING
from optodrive.core.quantity import format_quantity, list_names
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.measurements import DataFinding, Measurement, Signal
from optodrive.lab.inspection.repeat_faults import SAME_PHASE, find_gains, find_lost, find_noisy, find_outliers
from optodrive.lab.inspection.response_faults import RESPONSE_STEPS
from optodrive.lab.inspection.saturation import find_saturation
from optodrive.lab.inspection.signal_faults import (
    Slow,
    find_ceiling,
    find_hold,
    find_interpolation,
    find_sentinels,
    find_stuck,
    measure_noise,
    select_near_ceiling,
)
from optodrive.lab.inspection.start_times import KIND as START_TIMES
from optodrive.lab.inspection.start_times import read_start_times
from optodrive.lab.inspection.work import (
    Edit,
    Found,
    Step,
    Work,
    count,
    count_samples,
    describe_extent,
    find_unit,
    format_span,
    select_finite,
)

DRIFT_SIGMAS = 1.5
"""Drift within runs and shift by the light, relative to the noise, from which they are stated."""
LOWEST_K, HIGHEST_K = 1.0, 5000.0
"""Limits of a possible temperature."""
FEW_PARTS = 3
"""Smallest number of rows or lines of a slower channel in a run where others show it by more."""
TEMPERATURE = "absorber_temperature_K"
HELD = "each sample is repeated until the next, every {every}; the first counts"
INTERPOLATED = "samples lie on lines between points {every} apart; these points count"


@dataclass(frozen=True, eq=False)
class Inspection:
    """Findings, the recording without unusable data, and failed steps."""

    findings: tuple[DataFinding, ...]
    measurement: Measurement
    failures: tuple[str, ...] = ()

    @property
    def omitted(self) -> tuple[DataFinding, ...]:
        """Findings that left data out."""
        return tuple(item for item in self.findings if item.action == "left out")

    @property
    def remarks(self) -> tuple[str, ...]:
        """Texts of noted findings other than sampling and noise."""
        return tuple(item.text for item in self.findings if item.action == "noted" and item.kind not in FACTS)

    def check(self) -> None:
        """Raise InputError for the first finding that is refused, or if nothing is left."""
        for item in self.findings:
            if item.action == "refused":
                where = f"recording: {list_names(item.runs)}: {item.kind}"
                raise InputError(where, Unquoted("what cannot be used"), item.text.rstrip("."))
        values = (signal.value for run in self.measurement.runs for signal in run.signals.values())
        if self.omitted and not any(np.isfinite(value).any() for value in values):
            reason = self.omitted[-1].text.removesuffix("; left out.")
            raise InputError("recording", Unquoted("no signal that can be used"), f"at least one; {reason}")


def inspect_recording(measurement: Measurement, use: Iterable[str] = ()) -> Inspection:
    """Inspect a recording.

    use: kinds that are noted only, so that what they concern stays in the recording
    """
    used, work = frozenset(use), Work(measurement)
    findings: list[DataFinding] = []
    failures: list[str] = []
    for step in STEPS:
        is_refused = any(item.kind in RESPONSE_KINDS and item.action == "refused" for item in findings)
        if step in RESPONSE_STEPS and is_refused:
            continue  # what is refused already would be found once more under other names
        for name in [""] if step.is_joint else work.names:
            try:
                with np.errstate(all="ignore"):
                    for item in step.find(work, name):
                        findings.append(item if isinstance(item, DataFinding) else _act(work, step.kind, used, *item))
            except Exception as error:  # an optional step never takes the answer along
                failures.append(f"{step.kind}{' of ' if name else ''}{name}: {type(error).__name__}: {error}")
    return Inspection(tuple(findings), work.build(), tuple(failures))


def _act(work: Work, kind: str, used: frozenset[str], edits: list[Edit], text: str) -> DataFinding:
    """Apply the edits of a fault unless its kind is used, and return the finding."""
    name, is_used = edits[0].name, kind in used
    runs = tuple(dict.fromkeys(work.runs[item.run].name for item in edits))
    values, unit = np.concatenate([item.values for item in edits]), find_unit(name)
    numbers = {"lowest": (float(values.min()), unit), "highest": (float(values.max()), unit)} if len(values) else {}
    if not is_used:
        work.apply(edits)
    action, end = ("noted", "used all the same") if is_used else ("left out", "left out")
    return DataFinding(runs, name, kind, f"{text}; {end}.", action, count_samples(edits), numbers)


def _mask_all(work: Work, name: str, find: Callable[[FloatArray], BoolArray]) -> list[Edit]:
    return work.remove(name, [(run, find(value)) for run, _, value in work.list_finite(name) if len(value)])


def _find_sentinels(work: Work, name: str) -> Found:
    high = RECORDING[name].high
    centre = float(np.median(np.concatenate([value for _, _, value in work.list_finite(name)])))
    limits = (LOWEST_K, HIGHEST_K) if name == TEMPERATURE else (centre - high, centre + high)
    if edits := _mask_all(work, name, lambda value: find_sentinels(value, *limits)):
        found = np.unique(np.concatenate([item.values for item in edits]))
        shown = list_names([f"{value:.6g}" for value in found.tolist()])
        yield edits, f"{name}: {describe_extent(edits)} are {shown}, no measured value"


def _find_stuck(work: Work, name: str) -> Found:
    if edits := _mask_all(work, name, find_stuck):
        shown = format_span(np.concatenate([item.values for item in edits]), find_unit(name))
        yield edits, f"{name}: {describe_extent(edits)} are stuck at {shown}"


def _find_slow(work: Work, name: str, find: Callable[..., Slow], text: str) -> Found:
    """Find a slower channel whose own samples alone are kept."""
    edits, intervals_s, signals = [], [], work.list_finite(name)
    is_slow = any(find(t_s, value) for _, t_s, value in signals)
    for run, t_s, value in signals:
        # Once one run shows it, a few parts suffice in those too short to show it by themselves.
        found = find(t_s, value, FEW_PARTS) if is_slow else None
        if found is not None:
            interval_s, own_s, own = found
            intervals_s.append(interval_s)
            edits.append(Edit(run, name, replace(work.signals[run, name], t_s=own_s, value=own), value, len(own)))
    if edits:
        every = format_span(np.array(intervals_s), "s")
        yield edits, f"{name}: in {count(len(edits), 'run')} {text.format(every=every)}"


def _find_clipped(work: Work, name: str) -> Found:
    is_mirror = name.startswith("mirror")
    for sign, side in ((1.0, "highest"), (-1.0, "lowest")):
        signals = work.list_finite(name)
        tops = [find_ceiling(t_s, sign * value, sign > 0.0 and not is_mirror) for _, t_s, value in signals]
        found = [top for top in tops if top is not None]
        ceiling, reach, where = min(found, default=0.0), 0.0, f"where the signal is clipped, its {side} value"
        if not found:
            level = find_saturation(work, name)
            if level is None or level[0] != sign:
                continue
            ceiling, reach = sign * level[1], level[2]
            where = f"where the signal saturates, its {side} value but for noise"
        near = [(run, select_near_ceiling(sign * value, ceiling, reach)) for run, _, value in signals]
        if edits := work.remove(name, near):
            samples, runs = count_samples(edits), count(len(edits), "run")
            share = samples / sum(len(value) for _, _, value in signals)
            at = format_quantity(sign * ceiling, find_unit(name))
            yield edits, f"{name}: {count(samples, 'sample')} ({share:.1%}) of {runs} are at or near {at}, {where}"


def _note_sampling(work: Work, name: str) -> Found:
    signals = [(number, signal) for number, signal in work.list_signals(name) if len(signal.t_s) > 2]
    if not signals:
        return
    intervals_s = np.array([float(np.median(np.diff(signal.t_s))) for _, signal in signals])
    total = sum(len(signal.t_s) for _, signal in signals)
    missing = sum(int(np.isnan(signal.value).sum()) for _, signal in signals)
    rate = f"{1.0 / intervals_s.max():.4g}"
    rate += f" to {1.0 / intervals_s.min():.4g}" if np.ptp(intervals_s) > 0.01 * intervals_s.min() else ""
    text = f"{name}: {count(total, 'sample')} in {count(len(signals), 'run')} at {rate} Hz"
    text += f", {missing / total:.1%} of them missing" if missing else ""
    gaps = [(float(np.diff(select_finite(signal)[0]).max(initial=0.0)), number) for number, signal in signals]
    longest_s, at = max(gaps)
    if longest_s > 10.0 * intervals_s.max():
        text += f", the longest gap {format_quantity(longest_s, 's')} in {work.runs[at].name}"
    free = [number for number, signal in signals if _has_other_phase(work, number, name, signal)]
    text += f"; {count(len(free), 'run')} sampled at other phases than their repeats" if free else ""
    runs = tuple(work.runs[number].name for number, _ in signals)
    numbers = {"interval": (float(np.median(intervals_s)), "s"), "missing": (missing / total, "1")}
    yield DataFinding(runs, name, "sampling", f"{text}.", samples=total, numbers=numbers)


def _has_other_phase(work: Work, run: int, name: str, signal: Signal) -> bool:
    others = [work.signals[other, name] for other in work.find_repeats(run) if (other, name) in work.signals]
    interval_s = float(np.median(np.diff(signal.t_s)))
    shifts_s = [float(other.t_s[0] - signal.t_s[0]) + 0.5 * interval_s for other in others]
    return any(abs(shift_s % interval_s - 0.5 * interval_s) > SAME_PHASE * interval_s for shift_s in shifts_s)


def _note_noise(work: Work, name: str) -> Found:
    found = [measure_noise(value) for _, _, value in work.list_finite(name) if len(value) >= 16]
    if not found:
        return
    sigma, quantum = (float(np.median([getattr(item, key) for item in found])) for key in ("sigma", "quantum"))
    unit = find_unit(name)
    text = f"{name}: noise of {format_quantity(sigma, unit)} between neighbouring samples"
    if quantum:
        coarse = ", coarser than the noise" if quantum > 2.0 * sigma else ""
        text += f", resolution {format_quantity(quantum, unit)}{coarse}"
    drift, shift = _measure_drift(work, name)
    text += f"; repeats drift apart by {format_quantity(drift, unit)} in a run" if drift > DRIFT_SIGMAS * sigma else ""
    if -shift > DRIFT_SIGMAS * sigma:
        text += f"; {format_quantity(-shift, unit)} lower after the light than before it, as behind a high-pass"
    numbers = {"noise": (sigma, unit), "resolution": (quantum, unit), "drift": (drift, unit), "shift": (shift, unit)}
    runs = tuple(work.runs[number].name for number, _ in work.list_signals(name))
    yield DataFinding(runs, name, "noise", f"{text}.", numbers=numbers)


def _measure_drift(work: Work, name: str) -> tuple[float, float]:
    """Return by how much ends of repeats differ that begin alike, rms, and ends from beginnings, the median."""
    ends = {}
    for number, t_s, value in work.list_finite(name):
        rows = int(np.searchsorted(t_s, work.runs[number].pulses[:, 0].min(initial=np.inf)))  # before any light
        if 3 < rows < len(value) // 2:
            ends[number] = float(value[-rows:].mean() - value[:rows].mean())
    pairs = [ends[run] - ends[other] for run in ends for other in work.find_repeats(run) if other in ends]
    return float(np.sqrt(np.mean(np.square(pairs or [0.0])) / 2.0)), float(np.median(list(ends.values()) or [0.0]))


STEPS = (
    Step("sentinel", _find_sentinels),
    Step("held", lambda work, name: _find_slow(work, name, find_hold, HELD)),
    Step("interpolated", lambda work, name: _find_slow(work, name, find_interpolation, INTERPOLATED)),
    Step("stuck", _find_stuck),
    Step("clipped", _find_clipped),
    Step("outlier", find_outliers),
    Step("noisy", find_noisy),
    *RESPONSE_STEPS,
    Step("lost", find_lost, is_joint=True),
    Step("gain", find_gains),
    Step(START_TIMES, lambda work, _: iter(read_start_times(work.runs).findings), is_joint=True),
    Step("sampling", _note_sampling),
    Step("noise", _note_noise),
)
RESPONSE_KINDS = tuple(step.kind for step in RESPONSE_STEPS)
FACTS = ("sampling", "noise")
KINDS = tuple(step.kind for step in STEPS if step.kind not in FACTS)
"""Kinds of findings that may leave something out, which `use` puts back."""
