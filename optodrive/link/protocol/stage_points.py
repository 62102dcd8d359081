"""Points of a plan for the board of each stage, and where a running plan is cut for a newer one to replace the rest."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple, Self

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import BoolArray, IntArray
from optodrive.core.types.plans import LimitedPlan
from optodrive.link.protocol.quantisation import DecodedPulses, WirePoints, WireScale, decode, quantise

POINT_BYTES = 10
DAMAGED_POINTS = "the points differ from those that were verified (CRC-32)"


@dataclass(frozen=True, eq=False)
class StagePoints:
    """Points of a plan for the board of each stage.

    Those of several boards end at the same time, with the gate off, so that all of them execute the plan to its end.
    """

    stages: tuple[WirePoints, ...]

    @classmethod
    def from_plan(cls, plan: LimitedPlan, scales: Sequence[WireScale], draws: BoolArray | None = None) -> Self:
        """Quantise a plan. Raise LocalProtocolError as `quantise` does.

        scales: of each stage; draws: whether each takes part, all by default; the others get no points
        """
        stages = tuple(quantise(plan, scale, stage) for stage, scale in enumerate(scales))
        if len(stages) > 1:
            end_tick = max(int(points.compute_end_ticks()[-1]) if len(points) else 0 for points in stages)
            stages = tuple(
                points.extend(end_tick) if draws is None or draws[stage] else points
                for stage, points in enumerate(stages)
            )
        return cls(stages)

    @classmethod
    def from_payload(cls, payload: bytes, counts: Sequence[int]) -> Self:
        """Read a payload of encode_payload(). counts: number of points per stage. Raise ValueError if they differ."""
        if len(payload) != POINT_BYTES * sum(counts) or min(counts) < 0:
            raise ValueError(f"{len(payload)} bytes for {sum(counts)} points")
        table = np.frombuffer(payload, dtype="<u2").reshape(-1, 5)
        parts = np.split(table, list(accumulate(counts))[:-1])
        return cls(tuple(WirePoints(part, np.zeros(len(part), dtype=np.int64)) for part in parts))

    @property
    def counts(self) -> list[int]:
        """Number of points of each stage."""
        return [len(points) for points in self.stages]

    def encode_payload(self) -> bytes:
        """Return the points of all stages as the bytes in DATA, stage after stage."""
        return b"".join(points.encode_payload() for points in self.stages)

    def count_before(self, row: int) -> list[int]:
        """Return the number of points of each stage up to its last pulse before the plan's row `row`."""
        return [points.count_before(row) for points in self.stages]

    @property
    def ends_with_gate_on(self) -> bool:
        """Whether the last point of each stage turns the gate on, so that the mirrors do not stand at a later pulse."""
        return all(len(points) and points.table[-1, 3] for points in self.stages)

    def split_behind(self, first: Self) -> Self:
        """Return the points behind those of a first part. Raise LocalProtocolError unless that is how they begin."""
        pairs = list(zip(self.stages, first.stages, strict=True))
        if not all(np.array_equal(one.table[: len(before)], before.table) for one, before in pairs):
            raise LocalProtocolError("the points of a plan's first part differ from those handed over")
        return type(self)(tuple(WirePoints(one.table[len(b) :], one.row[len(b) :]) for one, b in pairs))

    def add_pauses(self, ticks: Sequence[int]) -> Self:
        """Return the points of each stage behind a further pause of `ticks`, with the gate off."""
        return type(self)(tuple(points.add_pause(each) for points, each in zip(self.stages, ticks, strict=True)))

    def shift_rows(self, first: int) -> Self:
        """Return the points of a plan of which `first` rows precede these."""
        return type(self)(
            tuple(WirePoints(one.table, np.where(one.row >= 0, one.row + first, -1)) for one in self.stages)
        )


def decode_stages(payload: bytes, points: StagePoints, scales: Sequence[WireScale]) -> tuple[IntArray, DecodedPulses]:
    """Decode the payload of points. Return the pulses of all stages, and the plan's rows to which they belong, [n]."""
    decoded: list[DecodedPulses] = []
    first = 0
    for one, scale in zip(points.stages, scales, strict=True):
        decoded.append(decode(payload[POINT_BYTES * first : POINT_BYTES * (first + len(one))], scale))
        first += len(one)
    row = np.concatenate([one.row[each.index] for one, each in zip(points.stages, decoded, strict=True)])
    if len(decoded) == 1:
        return row, decoded[0]
    columns = {name: np.concatenate([getattr(each, name) for each in decoded]) for name in vars(decoded[0])}
    return row, DecodedPulses(**columns)


class PointCut(NamedTuple):
    """Cut through the points of all stages.

    kept_points: number of points of each stage before it; row: first row of the plan after it
    end_tick: at which the last kept point ends, from the plan's zero; aim_rows: row at whose pixel the mirrors of each
    stage point then, −1 if no pulse precedes
    """

    kept_points: list[int]
    row: int
    end_tick: int
    aim_rows: list[int]

    @classmethod
    def find(cls, points: StagePoints, sent_tick: float) -> Self:
        """Find the earliest cut that keeps each point that begins before sent_tick from the plan's zero.

        A kept point that only moves the mirrors towards a pulse keeps the pulse: the mirrors' heat counts with it.
        """
        ends = [one.compute_end_ticks() for one in points.stages]
        # A point begins at the end of the one before it.
        kept = [0 if sent_tick <= 0 else min(len(end), int(np.searchsorted(end[:-1], sent_tick)) + 1) for end in ends]
        row = -1
        while True:
            for stage, one in enumerate(points.stages):
                count = kept[stage]
                if count and not one.table[count - 1, 3]:
                    gate_on = np.flatnonzero(one.table[count:, 3])
                    kept[stage] = count + int(gate_on[0]) + 1 if len(gate_on) else count
                row = max(row, int(one.row[: kept[stage]].max(initial=-1)))
            before = points.count_before(row + 1)
            if all(count <= enough for count, enough in zip(before, kept, strict=True)):
                break
            kept = [max(pair) for pair in zip(kept, before, strict=True)]
        end_tick = max(int(end[count - 1]) if count else 0 for end, count in zip(ends, kept, strict=True))
        aims = []
        for one, count in zip(points.stages, kept, strict=True):
            rows = one.row[:count][one.table[:count, 3] > 0]
            aims.append(int(rows[-1]) if len(rows) else -1)
        return cls(kept, row + 1, end_tick, aims)
