"""Data that fits and search never see.

It does not lie between fitted samples, where anything smooth in time would predict it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.lab.discovery.model import Record

WHOLE_EVERY = 3
MIN_SAMPLES = 64
FOLDS = 4
"""Parts of the fitted samples over which the search cross-validates."""
PIECES = 32
SEARCH_SAMPLES = 12_000
"""Samples that the search uses at most; the fits of free runs use all."""


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
