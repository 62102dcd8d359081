"""Data that fits and search never see, and models that are fitted in free run without it.

It does not lie between fitted samples, where anything smooth in time would predict it.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.lab.discovery.fitting import Point, Simulation, fit, output_sizes, run_errors
from optodrive.lab.discovery.model import Record
from optodrive.lab.discovery.screening import Candidate
from optodrive.lab.inference.claim import MIN_KEPT, SplitGain

WHOLE_EVERY = 3
MIN_SAMPLES = 64
FOLDS = 4
"""Parts of the fitted samples over which the search cross-validates."""
PIECES = 32
SEARCH_SAMPLES = 12_000
"""Samples that the search uses at most; the fits of free runs use all."""

SHORT_FIT, MEMORY_FIT, LONG_FIT = 12, 24, 60
"""Steps of a fit of a rival, of one with memory, whose scale starts from a coarse grid, and of what was chosen."""
BEYOND, WEAK = 2.0, 0.1
"""How much further a threshold may move in the last fit, relative to its limits, and the share of a term's amplitude
from which that fit begins once more."""
PARTS = 64
"""Parts of a split's held-out samples in which forms are compared."""
WITHIN_NOISE = 1.1
"""Error in units of noise below which nothing is left to gain."""
UNCOMPUTABLE = (np.linalg.LinAlgError, ArithmeticError, ValueError)
"""Errors of one candidate, which it alone is lost by."""


@dataclass(frozen=True, eq=False)
class Split:
    """Division of the samples into fitted ones and others.

    name: of the part that is held out; fitted: masks [m] by record
    """

    name: str
    fitted: tuple[BoolArray, ...]

    @property
    def held_out(self) -> list[BoolArray]:
        """Samples [m] of each record that are held out."""
        return [~mask for mask in self.fitted]


def choose_splits(records: Sequence[Record]) -> tuple[Split, ...]:
    """Return the splits by whole records, or by thirds of a single one.

    Of several records, every third in order of size, the largest and the smallest are held out; of one, either end.

    The first split is that of the search. It fits the largest record: an effect that this alone shows would be found in
    no other.
    """
    total = sum(len(record.t_s) for record in records)
    if total < MIN_SAMPLES:
        raise InputError("train", f"{total} samples", f"{MIN_SAMPLES} or more")
    if len(records) == 1:
        row = np.arange(total)
        return Split("the last third", (3 * row < 2 * total,)), Split("the first third", (3 * row >= total,))
    order = np.argsort([-size for size in _measure_sizes(records)], kind="stable").tolist()
    groups = {tuple(order[1::WHOLE_EVERY]): "", (order[0],): " (the largest)", (order[-1],): " (the smallest)"}
    return tuple(
        Split(
            ", ".join(records[k].name or f"record {k + 1}" for k in sorted(group)) + which,
            tuple(np.full(len(record.t_s), k not in group) for k, record in enumerate(records)),
        )
        for group, which in groups.items()
    )


def _measure_sizes(records: Sequence[Record]) -> list[float]:
    """Return the size of the outputs of each record, relative to all records."""
    rms = np.array([np.sqrt(np.nan_to_num(record.outputs**2).mean(axis=0)) for record in records])
    sizes: list[float] = (rms / np.maximum(rms.max(axis=0), 1e-300)).sum(axis=1).tolist()
    return sizes


def prepare_search(records: Sequence[Record], split: Split) -> list[tuple[Record, IntArray]]:
    """Return the records of the search, of long ones a beginning of each piece, with the fold of each sample [m].

    The fold is −1 where a sample is held out. Folds are whole records if several are fitted, else parts of the one.
    """
    used = sum(bool(mask.any()) for mask in split.fitted)
    total, number, prepared = sum(len(record.t_s) for record in records), 0, []
    for record, mask in zip(records, split.fitted, strict=True):
        fold = np.full(len(mask), -1)
        fold[mask] = number % FOLDS if used > 1 else np.arange(mask.sum()) * FOLDS // mask.sum()
        number += bool(mask.any())
        if total <= SEARCH_SAMPLES or record.whiten:
            prepared.append((record, fold))
            continue
        for rows in np.array_split(np.arange(len(mask)), max(1, PIECES * len(mask) // total)):
            kept = rows[: max(100, len(rows) * SEARCH_SAMPLES // total)]
            piece = replace(record, t_s=record.t_s[kept], inputs=record.inputs[kept], outputs=record.outputs[kept])
            prepared.append((piece, fold[kept]))
    return prepared


def sum_parts(values: Sequence[FloatArray], masks: Sequence[BoolArray], parts: int) -> FloatArray:
    """Return the sums of values [m, o] over consecutive parts of the masked samples of all records."""
    joined = np.concatenate([each.sum(axis=1)[mask] for each, mask in zip(values, masks, strict=True)])
    return np.array([part.sum() for part in np.array_split(joined, min(parts, max(len(joined), 1)))])


@dataclass(frozen=True, eq=False)
class Measured:
    """A model fitted in each split.

    points: [splits]; rmse: [splits, 2] in free run where fitted and held out; logs: [parts] of squared errors held out
    in all splits; errors: [m, o] of each record, with the first split's numbers
    """

    points: tuple[Point, ...]
    rmse: FloatArray
    logs: FloatArray
    errors: list[FloatArray]


@dataclass(frozen=True, eq=False)
class Proposal:
    """A candidate with all numbers fitted by prediction errors, their squared sum, and the model in free run.

    point: its last term is the proposed one
    """

    candidate: Candidate
    point: Point
    loss: float
    measured: Measured | None = None

    def evaluate(self, z: FloatArray) -> FloatArray:
        """Return the values [n] of the proposed term at z [n]."""
        point = self.point if self.measured is None else self.measured.points[0]
        return self.candidate.form.apply(point.terms.values[-1], z)


class FreeRuns:
    """Models in free run, fitted in every split. noise: [o] of the outputs."""

    def __init__(
        self, simulation: Simulation, records: Sequence[Record], splits: Sequence[Split], noise: FloatArray
    ) -> None:
        self.simulation, self.records, self.splits, self.noise = simulation, records, splits, noise
        self.is_white = all(record.whiten is not None for record in records)
        self.sizes = np.ones(len(noise)) if self.is_white else output_sizes(records)
        self.floor = 1.0 if self.is_white else float(np.sqrt(np.mean((noise / self.sizes) ** 2)))

    def fit(self, starts: Sequence[Point], masks: Sequence[BoolArray], is_long: bool = False) -> Point:
        """Return the fit of free runs in masked samples from the best of some points. is_long: until it settles."""
        weights = [np.outer(mask, 1.0 / self.sizes) for mask in masks]
        start = min(starts, key=lambda each: _compute_rms(self.run(each), masks))
        evaluations = LONG_FIT if is_long else MEMORY_FIT if len(start.terms.memories) else SHORT_FIT
        return fit(self.simulation, self.records, start, weights, evaluations=evaluations)[0]

    def fit_everything(self, point: Point) -> Point:
        """Return the fit of free runs to all samples, from a point, or from its terms as weak ones.

        Beside a kink a strong term ends in a valley of its own. Thresholds may leave the range along the search's
        filter: parameters change that of a state which nobody measures.
        """
        point = point.with_terms(point.terms.free_thresholds(BEYOND))
        masks = [np.full(len(record.t_s), True) for record in self.records]
        weak = point.with_terms(point.terms.weaken(WEAK))
        fits = [self.fit([each], masks, is_long=True) for each in (point, weak)]
        return min(fits, key=lambda each: _compute_rms(self.run(each), masks))

    def run(self, point: Point) -> list[FloatArray]:
        """Return the errors [m, o] of free runs of all records."""
        return run_errors(self.simulation, self.records, point, self.sizes)

    def measure(self, starts: Sequence[Sequence[Point]], is_long: bool = False, max_rmse: float = np.inf) -> Measured:
        """Return a model fitted in each split from some points of it, of which the first split's answer is one more.

        Raises ValueError where the error of what the first split holds out is above max_rmse.
        """
        points, rmse, logs, first = list[Point](), list[list[float]](), list[FloatArray](), list[FloatArray]()
        for split, own in zip(self.splits, starts, strict=True):
            if rmse and rmse[0][1] > max_rmse:
                raise ValueError(f"error {rmse[0][1]:.4g}: no rival of the best one")
            points.append(self.fit([*own, *points[:1]], split.fitted, is_long))
            errors = self.run(points[-1])
            first = first or errors
            rmse.append([_compute_rms(errors, split.fitted), _compute_rms(errors, split.held_out)])
            sums = sum_parts([each**2 for each in errors], split.held_out, PARTS)
            counts = sum_parts([np.ones(each.shape) for each in errors], split.held_out, PARTS)
            logs.append(np.log(sums / counts + self.floor**2))
        return Measured(tuple(points), np.array(rmse), np.concatenate(logs), first)

    def measure_gains(self, base: Measured, before: Measured, after: Measured) -> tuple[SplitGain, ...]:
        """Return the shares of the first model's avoidable error that a term removes, where there is any."""
        shares = (np.minimum(before.rmse, base.rmse) - after.rmse) / np.maximum(
            base.rmse - np.minimum(self.floor, after.rmse), 1e-12
        )
        is_quiet = np.maximum(before.rmse, after.rmse)[:, 1] <= WITHIN_NOISE * self.floor
        return tuple(
            SplitGain(split.name, *np.clip(share, -9.0, 1.0).tolist())
            for split, share, quiet in zip(self.splits, shares, is_quiet, strict=True)
            if not quiet
        )

    def measure_min_gain(self, base: Measured, before: Measured, after: Measured) -> float:
        """Return the smallest gain in held-out data, 0 where there is nothing to gain."""
        return min((each.held_out for each in self.measure_gains(base, before, after)), default=0.0)

    def measure_rivals(
        self, base: Measured, current: Measured, proposals: Sequence[Proposal], best: float
    ) -> list[Proposal]:
        """Return proposals fitted in every split from the model without their term, but for those that are no rivals.

        best: smallest held-out gain of another one
        """
        found = list[Proposal]()
        before, first = min(current.rmse[0, 1], base.rmse[0, 1]), base.rmse[0, 1]
        for each in proposals:
            term = each.point.terms[-1:]
            starts = [[point.with_terms(point.terms.extend(term))] for point in current.points]
            starts[0].insert(0, each.point)
            with suppress(*UNCOMPUTABLE):
                # What gains less than this share of another's gain in one split is no rival of it.
                enough = max(before - MIN_KEPT * best * (first - self.floor), WITHIN_NOISE * self.floor)
                measured = self.measure(starts, max_rmse=enough if best > 0.0 else np.inf)
                best = max(best, self.measure_min_gain(base, current, measured))
                found.append(replace(each, measured=measured))
        return found


def _compute_rms(errors: Sequence[FloatArray], masks: Sequence[BoolArray]) -> float:
    """Return the root mean square of errors [m, o] of each record over masked samples [m]."""
    squares = sum(float(np.sum(each[mask] ** 2)) for each, mask in zip(errors, masks, strict=True))
    count = sum(int(np.count_nonzero(each[mask])) for each, mask in zip(errors, masks, strict=True))
    return float(np.sqrt(squares / max(count, 1)))
