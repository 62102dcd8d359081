"""Faults of one run's signal that its repeats show: noise, lost samples, another gain, and single outliers.

Theory of operation

Repeats had the same light, so their difference holds what they do not share. A signal of one run is off if all its
repeats say so: by noise that is several times theirs, by samples that suit theirs only later from some sample on, or by
a scale that the other runs of the session do not lead to expect. What changes in the pixel from run to run does so in
order of time, so scales are compared with a smooth course through the session.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.quantity import format_quantity, list_names
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.measurements import Run
from optodrive.lab.inspection.response_faults import (
    compute_template,
    get_second_s,
    list_responding,
    measure_responses,
    measure_time_constant,
)
from optodrive.lab.inspection.signal_faults import find_outlier_candidates, measure_deviation, measure_noise
from optodrive.lab.inspection.work import Found, Work, describe_extent, measures_alike, select_finite

NOISIER = 4.0
"""Noise of a run relative to that of all runs, and to its quietest repeat's, from which the signal is left out."""
MIN_NOISE_RUNS = 4
"""Number of runs that tell the usual noise."""
MAX_LOST = 40
"""Largest number of lost samples."""
MAX_GAP = 2.5
"""Intervals without a sample that are a gap."""
LOST_EXCESS = 1.2
"""Mean square of the difference of repeats, in variances, from which lost samples are sought."""
LOST_LEAVES = 0.6
"""Largest share of these squares that is left with lost samples."""
LOST_GAIN = 60.0
"""Variances by which the sum of these squares is less with lost samples."""
LOST_CAP = 30.0
"""Variances that one sample counts at most, so that no few samples decide."""
GAIN_DIFFERS = 0.025
"""Smallest deviation of a run's scale from its repeats', relative."""
GAIN_SIGMAS = 7.0
"""The same in standard errors."""
GAIN_SPREAD = 0.004
"""Least spread of scales, relative."""
MIN_GAIN_RUNS = 6
"""Number of other runs that tell what scale to expect."""
GAIN_BLOCK = 15
"""Samples in the means by which the colour of noise is told."""
OFF_SHARE = 0.75
"""Smallest deviation of a scale relative to the largest among its repeats."""
SAME_PHASE = 0.05
"""Distance of samples of repeats that are compared, in intervals."""
EDGE_SAMPLES = 4.0
"""Distance of an outlier from an edge of the drive, in intervals."""
EDGE_S = 3e-3
"""The same as a time."""
REPEAT_SIGMAS = 4.5
"""Deviation of an outlier from a repeat."""
NEAR = 8
"""Samples on either side that judge an outlier."""
MAX_PASSES = 3
"""Passes by which outliers beside outliers are found."""
MAX_REPEATS = 3
"""Repeats with which outliers are compared."""
MIN_SAMPLES = 24
"""Smallest number of samples of a signal that is judged."""


def find_noisy(work: Work, name: str) -> Found:
    """Find runs with far more noise than most others, and than their repeats."""
    values = {run: value for run, _, value in work.list_finite(name) if len(value) >= MIN_SAMPLES}
    sigmas = {run: measure_noise(value).sigma for run, value in values.items()}
    usual = float(np.median(list(sigmas.values()))) if len(sigmas) >= MIN_NOISE_RUNS else 0.0
    noisy = []
    for number, sigma in sigmas.items():  # a train that is sampled slowly differs from other runs, not from repeats
        repeats = [sigmas[other] for other in work.find_repeats(number) if other in sigmas]
        if sigma > NOISIER * max(usual, min(repeats, default=0.0)) > 0.0:
            noisy.append(number)
    if noisy and 4 * len(noisy) <= len(sigmas):
        ratio = max(sigmas[number] for number in noisy) / usual
        yield work.drop(name, noisy), f"{name} of {work.list_runs(noisy)} has {ratio:.0f} times the noise of others"


def find_lost(work: Work, _: str) -> Found:
    """Find runs whose samples come too early from some sample on, because samples before it were lost."""
    found = {name: _list_early(work, name) for name in work.names if not name.startswith("mirror")}
    runs = [run for early in found.values() for run in early]
    for name, early in found.items():
        # what two signals of a run show is its trigger's, and holds for all of them
        all_of = {run: next(own[run] for own in found.values() if run in own) for run in runs if runs.count(run) > 1}
        off = {run: item for run, item in (all_of | early).items() if (run, name) in work.signals}
        if off:
            early_runs = ((work.runs[run].name, format_quantity(by_s, "s", 2), t_s) for run, (t_s, by_s) in off.items())
            shown = list_names([f"{run} (by {by} from {t_s:.3g} s on)" for run, by, t_s in early_runs])
            text = f"{name} of {shown} is earlier than in repeats: samples were lost, or trigger or clock are off"
            yield work.drop(name, off), text


def _list_early(work: Work, name: str) -> dict[int, tuple[float, float]]:
    """Return from when on, s, and by how much runs are earlier than most others of equal light, s."""
    shares = {item.run: abs(item.share) for item in measure_responses(work, name)}
    lost: dict[int, tuple[float, float]] = {}
    for number, share in shares.items():
        same = work.runs[number]  # groups of equal light tell more together
        alike = [run for run in shares if run != number and np.array_equal(work.runs[run].pulses, same.pulses)]
        repeats = [run for run in alike if measures_alike(work.runs[run], same)]
        own = select_finite(work.signals[number, name])
        better = [select_finite(work.signals[other, name]) for other in repeats if shares[other] > share]
        found = [early for other in better if (early := _find_early(*own, *other)) is not None]
        if 2 * len(found) > len(repeats):
            lost[number] = found[0]
    return lost


def _find_early(
    t_s: FloatArray, value: FloatArray, other_s: FloatArray, other: FloatArray
) -> tuple[float, float] | None:
    """Return from which time on samples suit later ones of a repeat, and how much later, s, or None."""
    dt_s = float(np.median(np.diff(t_s)))
    kept = t_s < other_s[-1] - dt_s
    t_s, value = t_s[kept], value[kept]
    if len(t_s) < MIN_SAMPLES:
        return None
    is_beside = np.append(np.diff(other_s) < MAX_GAP * dt_s, True)  # no value is known within a gap

    def is_measured(at_s: FloatArray) -> BoolArray:
        return is_beside[np.clip(np.searchsorted(other_s, at_s) - 1, 0, len(other_s) - 1)]

    same = np.interp(t_s, other_s, other)
    variance = measure_noise(value).sigma ** 2 + measure_noise(other).sigma ** 2
    design, is_usable = np.column_stack([np.ones(len(t_s)), same]), is_measured(t_s)
    fit = np.linalg.lstsq(design[is_usable], value[is_usable], rcond=None)[0]
    cap = LOST_CAP * variance  # so that no few samples decide
    free, now = (np.minimum((value - line) ** 2, cap) for line in (design @ fit, same))
    if min(free[is_usable].mean(), now[is_usable].mean()) < LOST_EXCESS * variance:
        return None
    best = 0.0, 0, 0, np.inf
    for steps in range(1, MAX_LOST + 1):
        later_s = t_s + steps * dt_s
        is_known = (later_s <= other_s[-1]) & is_usable & is_measured(later_s)
        later = np.minimum((value - np.interp(later_s, other_s, other)) ** 2, cap)
        before = np.concatenate([[0.0], np.cumsum(np.where(is_known, now, 0.0))[:-1]])
        left = before + np.cumsum(np.where(is_known, later, 0.0)[::-1])[::-1]
        at, total = int(np.argmin(left)), min(float(item[is_known].sum()) for item in (free, now))
        better = total - float(left[at])
        if left[at] < LOST_LEAVES * total and better > best[0]:
            best = better, at, steps, float(left[at]) / max(int(is_known.sum()), 1)
    better, at, steps, rest = best
    return (float(t_s[at]), steps * dt_s) if better > LOST_GAIN * max(variance, rest) and steps else None


@dataclass(frozen=True)
class _Scale:
    """Logarithm of the scale of one run's signal against its repeats, with its standard error."""

    run: int
    group: int
    value: float
    error: float


def find_gains(work: Work, name: str) -> Found:
    """Find runs whose signal has another scale than its repeats, though of the same form."""
    scales = _measure_scales(work, name)
    off: dict[int, float] = {}
    for item in scales:
        others = [other for other in scales if other.run != item.run]
        repeats = [other.value for other in others if other.group == item.group]
        if len(others) < MIN_GAIN_RUNS or not repeats:
            continue
        expected, error = _expect(item, others)
        found = item.value - expected, item.value - float(np.median(repeats))
        deviation = 0.0 if found[0] * found[1] < 0.0 else min(found, key=abs)  # few runs mislead the course
        if abs(deviation) > max(GAIN_DIFFERS, GAIN_SIGMAS * error):
            off[item.run] = deviation
    if not off or 4 * len(off) > len(scales):
        return
    groups = {item.run: item.group for item in scales}
    largest = {groups[run]: max(abs(off[other]) for other in off if groups[other] == groups[run]) for run in off}
    off = {run: value for run, value in off.items() if abs(value) > OFF_SHARE * largest[groups[run]]}
    shown = list_names([f"{work.runs[n].name} ({np.expm1(value):+.1%})" for n, value in off.items()])
    text = f"{name} of {shown} has another scale than its repeats: the gain or the power was another"
    if len(off) > 1:
        text += ", in one of two where these are repeats of each other"
    yield work.drop(name, off), text


def _expect(item: _Scale, others: list[_Scale]) -> tuple[float, float]:
    """Return the scale that other runs lead to expect, and its standard error.

    Each group of repeats has a level of its own, and all have one smooth course through the session.
    """
    groups = list(dict.fromkeys(other.group for other in others))
    last = max(max(other.run for other in others), item.run)

    def build(rows: list[_Scale]) -> FloatArray:
        order = np.array([row.run / last for row in rows])
        return np.column_stack([order, order**2, *(np.array([row.group == group for row in rows]) for group in groups)])

    design, value = build(others), np.array([other.value for other in others])
    error = np.hypot(GAIN_SPREAD, [other.error for other in others])
    size = np.array([sum(row.group == other.group for row in others) for other in others])
    is_off, excess = np.zeros(len(others), dtype=bool), 1.0
    for _ in range(3):  # another run that is off takes no part
        weight = np.where(is_off, 1e-3, 1.0) / error
        solved = np.linalg.lstsq(design * weight[:, None], value * weight, rcond=1e-6)[0]
        pull = np.abs(value - design @ solved) / error * np.sqrt(size / np.maximum(size - 1, 1))
        excess = max(1.0, 1.4826 * float(np.median(pull[size > 1])) if np.any(size > 1) else 0.0)
        is_off = pull > 3.0 * excess
    own = sum(other.group == item.group for other in others)
    return float((build([item]) @ solved)[0]), excess * float(np.hypot(GAIN_SPREAD, item.error) * np.sqrt(1 + 1 / own))


def _measure_scales(work: Work, name: str) -> list[_Scale]:
    """Return the scale of each run that responds and has repeats."""
    tau_s = measure_time_constant(work, name)
    gains = {item.run: item.gain for item in measure_responses(work, name) if item.is_seen and item.gain > 0.0}
    left: dict[int, tuple[FloatArray, FloatArray]] = {}
    sizes: dict[int, float] = {}
    for number, _, pulses, t_s, value in list_responding(work, name):
        if number in gains:
            template = compute_template(pulses, t_s, tau_s, get_second_s(name))
            template -= template.mean()
            sizes[number] = float(template @ template)
            left[number] = t_s, value - value.mean() - gains[number] * template
    out = []
    for number, size in sizes.items():
        repeats = [other for other in work.find_repeats(number) if other in sizes]
        if repeats:  # what repeats share is no noise but the form of the response
            t_s, own = left[number]
            noise = own - np.median([np.interp(t_s, *left[other]) for other in repeats], axis=0)
            rows = len(noise) // GAIN_BLOCK * GAIN_BLOCK
            means = noise[:rows].reshape(-1, GAIN_BLOCK).mean(axis=1)
            power = max(float((noise**2).mean()), GAIN_BLOCK * float((means**2).mean()))
            error = float(np.sqrt(power / size)) / gains[number]
            out.append(_Scale(number, min(number, *repeats), float(np.log(gains[number])), error))
    return out


def find_outliers(work: Work, name: str) -> Found:
    """Find single samples that deviate from those beside them and from the repeats."""
    bad, largest = {}, 0.0
    for number, t_s, value in work.list_finite(name):
        if len(value) < MIN_SAMPLES:
            continue
        rows, is_bad = np.arange(len(value)), np.zeros(len(value), dtype=bool)
        repeats = _list_alike(work, number, name, t_s)
        for _ in range(MAX_PASSES):
            kept = rows[~is_bad]
            new = _list_outliers(work.runs[number], t_s[kept], value[kept], [other[kept] for other in repeats])
            for first, width, score in new:
                is_bad[kept[first : first + width]] = True
                largest = max(largest, score)
            if not new:
                break
        bad[number] = is_bad
    if edits := work.remove(name, bad.items()):
        extent = f"{describe_extent(edits)} ({work.list_runs(item.run for item in edits)})"
        yield edits, f"{name}: {extent} up to {largest:.0f} σ off the samples beside them, and no repeat is"


def _list_alike(work: Work, run: int, name: str, t_s: FloatArray) -> list[FloatArray]:
    """Return the values of repeats at the same times, NaN where they have none."""
    interval_s = float(np.median(np.diff(t_s)))
    alike = []
    for other in work.find_repeats(run):
        signal = work.signals.get((other, name))
        if signal is None:
            continue
        other_s, value = select_finite(signal)
        if len(other_s) < MIN_SAMPLES:
            continue
        row = np.clip(np.searchsorted(other_s, t_s), 1, len(other_s) - 1)
        row -= np.abs(other_s[row - 1] - t_s) < np.abs(other_s[row] - t_s)
        is_same = np.abs(other_s[row] - t_s) < SAME_PHASE * interval_s
        if is_same.mean() > 0.5:
            alike.append(np.where(is_same, value[row], np.nan))
    return alike[:MAX_REPEATS]


def _list_outliers(
    run: Run, t_s: FloatArray, value: FloatArray, repeats: list[FloatArray]
) -> list[tuple[int, int, float]]:
    """Return first sample, number of samples and σ of outliers that no repeat shares."""
    edges_s = _list_edges(run)
    reach_s = max(EDGE_SAMPLES * float(np.median(np.diff(t_s))), EDGE_S)
    noise = measure_noise(value)
    sigma = max(noise.sigma, 0.5 * noise.quantum)
    found = []
    for first, width, score in find_outlier_candidates(t_s, value):
        own = np.arange(first, first + width)
        compared = [other for other in repeats if np.isfinite(other[own]).all()]
        is_far = not len(edges_s) or float(np.abs(edges_s[:, None] - t_s[own]).min()) > reach_s
        if all(_differs(value - other, own, sigma) for other in compared) and (compared or is_far):
            found.append((first, width, score))
    taken = {row for first, width, _ in found for row in range(first, first + width)}
    for at, other in enumerate(repeats):  # in a difference of repeats the signal itself is no longer in the way
        is_common = np.isfinite(other)
        rows = np.flatnonzero(is_common)
        for first, width, score in find_outlier_candidates(t_s[rows], (value - other)[rows], noise.quantum):
            own = rows[first : first + width]
            others = [item for number, item in enumerate(repeats) if number != at and np.isfinite(item[own]).all()]
            is_mine = all(_differs(value - item, own, sigma) for item in others)
            if not others:
                mine, its = (measure_deviation(t_s[rows], item[rows], first, width)[0] for item in (value, other))
                is_mine = mine > its
            if is_mine and not taken.intersection(own.tolist()):
                taken.update(own.tolist())
                found += [(int(row), 1, score) for row in own]
    return found


def _differs(difference: FloatArray, own: IntArray, sigma: float) -> bool:
    """Return whether samples of a difference of repeats deviate from those beside them."""
    near = difference[max(own[0] - NEAR, 0) : own[-1] + NEAR + 1]
    near = near[np.isfinite(near)]
    centre = float(np.median(near))
    spread = max(1.4826 * float(np.median(np.abs(near - centre))), 1.4 * sigma)
    return bool((np.abs(difference[own] - centre) > REPEAT_SIGMAS * spread).all())


def _list_edges(run: Run) -> FloatArray:
    """Return the times at which light or mirrors change."""
    commands_s = np.zeros(0) if run.commands is None else run.commands[:, 0]
    return np.concatenate([run.pulses[:, 0], run.pulses[:, 0] + run.pulses[:, 1], commands_s])
