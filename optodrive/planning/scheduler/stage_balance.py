"""Share of recurring pixels among the stages, balanced over a whole plan, because a pixel keeps its stage.

A local search over a model of the plan: a stage begins a frame once every pulse of the one before has begun on all.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray

WORK_MAX = 5_000_000
"""Steps of the search at most, some 15 ms."""
PASSES_MAX = 20
LEVEL_WEIGHT = 0.1
"""Weight of what the stages wait for the last one of a frame, against the time at which it ends."""
GAIN_MIN = 1e-7


class FrameLoads(NamedTuple):
    """Beam time of the frames of a plan [f], s.

    loads_s: [f, k] of the pixels whose stage is decided; shared_s: of those that are shared later, so that the stages
    end together; show_at_s: begin of the frame; overlap_s: by how much a stage may be ahead of the one before
    """

    loads_s: FloatArray
    shared_s: FloatArray
    show_at_s: FloatArray
    overlap_s: FloatArray


def balance(loads: FrameLoads, cost_s: FloatArray, stage: IntArray, reach: BoolArray) -> None:
    """Move and exchange pixels [n] between stages while the plan ends earlier. This modifies stage and loads.loads_s.

    cost_s: [f, n] beam time of each pixel in each frame; stage: [n]; reach: [k, n]
    """
    _search(*loads, np.ascontiguousarray(cost_s.T), stage, reach, np.zeros(len(reach)), np.zeros(len(cost_s)))


def find_drawing_s(loads: FrameLoads) -> float:
    """Return the time in which frames are drawn, without the waits for the begin of the next, s."""
    frames, stages = loads.loads_s.shape
    ends_s = np.zeros(frames)
    _find_end_s(*loads, np.zeros(stages), ends_s)
    begins_s = np.maximum(loads.show_at_s, np.append(0.0, ends_s[:-1]))
    return float((ends_s - begins_s).clip(min=0.0).sum())


@kernel
def _find_end_s(
    loads_s: FloatArray,
    shared_s: FloatArray,
    show_at_s: FloatArray,
    overlap_s: FloatArray,
    free_s: FloatArray,
    ends_s: FloatArray,
) -> float:
    """Return the mean end of the frames, with the last one counted twice, and the waiting times of the stages.

    Modifies free_s [k] and ends_s, the ends of the frames [f].
    """
    stages, total, end_s = loads_s.shape[1], 0.0, 0.0
    free_s[:] = 0.0
    for frame in range(len(loads_s)):
        begin_s = max(show_at_s[frame], end_s - overlap_s[frame])
        sum_s = 0.0
        for k in range(stages):
            free_s[k] = max(free_s[k], begin_s) + loads_s[frame, k]
            sum_s += free_s[k]
        level_s, end_s = (sum_s + shared_s[frame]) / stages, 0.0
        for k in range(stages):
            if shared_s[frame] > 0.0:
                free_s[k] = max(free_s[k], level_s)
            end_s = max(end_s, free_s[k])
        ends_s[frame] = end_s
        # Ends alone leave most moves without an effect; the wait of the other stages shows which way leads on.
        total += end_s + LEVEL_WEIGHT * max(0.0, end_s - level_s)
    return float(total / len(loads_s) + end_s)


@kernel
def _move(loads_s: FloatArray, cost_s: FloatArray, before: int, after: int) -> None:
    for frame in range(len(loads_s)):
        loads_s[frame, before] -= cost_s[frame]
        loads_s[frame, after] += cost_s[frame]


@kernel
def _search(
    loads_s: FloatArray,
    shared_s: FloatArray,
    show_at_s: FloatArray,
    overlap_s: FloatArray,
    cost_s: FloatArray,
    stage: IntArray,
    reach: BoolArray,
    free_s: FloatArray,
    ends_s: FloatArray,
) -> None:
    stages, pixels, work = loads_s.shape[1], len(stage), 0
    best_s = _find_end_s(loads_s, shared_s, show_at_s, overlap_s, free_s, ends_s)
    for _ in range(PASSES_MAX):
        has_changed = False
        for a in range(pixels):
            for k in range(stages):
                if k == stage[a] or not reach[k, a]:
                    continue
                before = stage[a]
                _move(loads_s, cost_s[a], before, k)
                end_s = _find_end_s(loads_s, shared_s, show_at_s, overlap_s, free_s, ends_s)
                work += loads_s.size
                if end_s < best_s - GAIN_MIN:
                    best_s, stage[a], has_changed = end_s, k, True
                else:
                    # Undone in place: a copy of all loads per trial would be most of the work.
                    _move(loads_s, cost_s[a], k, before)
            for b in range(a):
                first, second = stage[a], stage[b]
                if first == second or not reach[second, a] or not reach[first, b]:
                    continue
                _move(loads_s, cost_s[a], first, second)
                _move(loads_s, cost_s[b], second, first)
                end_s = _find_end_s(loads_s, shared_s, show_at_s, overlap_s, free_s, ends_s)
                work += loads_s.size
                if end_s < best_s - GAIN_MIN:
                    best_s, stage[a], stage[b], has_changed = end_s, second, first, True
                else:
                    _move(loads_s, cost_s[a], second, first)
                    _move(loads_s, cost_s[b], first, second)
                # Counted and not timed: equal sequences get equal plans on every computer.
                if work > WORK_MAX:
                    return
        if not has_changed:
            return
