"""Blocks of samples: which are fitted, which are held out, and pieces of them for the search."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, IntArray
from optodrive.lab.discovery.model import Record

BLOCKS = 32
HELD_OUT_EVERY = 4
MIN_BLOCK = 8
SEARCH_SAMPLES = 12_000
"""Samples that the search uses at most; the final fits use all."""


@dataclass(frozen=True, eq=False)
class Data:
    """Records with a block label of each sample [m], and the labels of fitted and of held-out blocks."""

    records: tuple[Record, ...]
    block: tuple[IntArray, ...]
    fitted: tuple[int, ...]
    held_out: tuple[int, ...]

    def masks(self, blocks: Sequence[int]) -> list[BoolArray]:
        """Return for each record which samples [m] lie in these blocks."""
        return [np.isin(labels, blocks) for labels in self.block]


def split(records: Sequence[Record], held_out: Sequence[int] = ()) -> Data:
    """Return the records in some 32 blocks of equal length, of which every fourth is held out.

    held_out: numbers of records that are held out as a whole; every record then is one block
    """
    if held_out:
        labels = [np.full(len(record.t_s), number) for number, record in enumerate(records)]
        fitted = tuple(number for number in range(len(records)) if number not in held_out)
        if not fitted:
            raise InputError("held_out", f"all {len(records)} records", "some records to be fitted")
        return Data(tuple(records), tuple(labels), fitted, tuple(held_out))
    total = sum(len(r.t_s) for r in records)
    if total < HELD_OUT_EVERY * 2 * MIN_BLOCK:
        raise InputError("train", f"{total} samples", f"{HELD_OUT_EVERY * 2 * MIN_BLOCK} or more")
    length = max(MIN_BLOCK, -(-total // BLOCKS))
    labels, offset = [], 0
    for record in records:
        count = max(1, round(len(record.t_s) / length))
        labels.append(offset + np.arange(len(record.t_s)) * count // len(record.t_s))
        offset += count
    held_out = tuple(range(HELD_OUT_EVERY - 1, offset, HELD_OUT_EVERY))
    return Data(tuple(records), tuple(labels), tuple(b for b in range(offset) if b not in held_out), held_out)


def thin(data: Data) -> Data:
    """Return the data of the search: everything, or of long records the beginning of each block as a record."""
    total = sum(len(r.t_s) for r in data.records)
    if total <= SEARCH_SAMPLES or any(record.whiten for record in data.records):
        return data
    pieces, labels = [], []
    for record, block in zip(data.records, data.block, strict=True):
        for label in np.unique(block):
            rows = np.flatnonzero(block == label)
            rows = rows[: max(100, len(rows) * SEARCH_SAMPLES // total)]
            pieces.append(Record(record.t_s[rows], record.inputs[rows], record.outputs[rows]))
            labels.append(block[rows])
    return replace(data, records=tuple(pieces), block=tuple(labels))
