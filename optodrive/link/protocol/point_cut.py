"""Where a running plan is cut, so that a newer one replaces its points that are not sent yet."""

from typing import NamedTuple, Self

import numpy as np

from optodrive.link.protocol.stage_points import StagePoints


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
