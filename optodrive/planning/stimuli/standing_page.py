"""Pixels of a standing page whose turn it is, those under fingers first.

Theory of operation. Pixels fall within a fraction of a second, and a beam raises one after another, so of a page of
some hundred dots each gets its turn about once a second, where touch wants twenty. A finger touches few of them. Every
pixel of the page is due REFRESH_PERIOD_S after its last pulse: a page of few dots takes no more energy than its rate
needs. As soon as a pixel under a finger is due, all of them that are due within BURST_S are drawn in one burst. The
beam time until the next of them is due goes to the rest of the page in the same way, unless so few pixels fit that they
are not worth the mirrors' way. How many are due does not matter: they are due together once they were drawn together.

All moves follow one tour of the page, because long ways heat the mirrors, which then must pause. A burst under fingers
goes on along the tour from where the beam stands, unless a pixel is late by LATE_S. Then, and in the rest of the page,
it begins where light is missing for longest. Bursts without a pause between them are one frame.
"""

from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.stimuli.frame_json import FRAME_DURATION_S

REFRESH_PERIOD_S = 0.04
"""Time from one pulse of a pixel to its next turn. Touch tells less than 20 per second from a standing dot."""
BURST_S = 0.012
LATE_S = 0.005
"""A pixel under a finger that is due for this time is drawn first."""
SLOT_S = 0.01
"""Light is planned for a number of slots, in each of which the places of the fingers are taken as fixed."""
SLOT_ROUNDING = 1e-9
REST_MIN = 6
"""Pixels away from the fingers that are worth the mirrors' way between two bursts under fingers."""
WAY_S = 1.5e-3
"""Time of the mirrors' way from the fingers to the rest of the page and back, beyond that between neighbours."""
WASTED_MAX_S = 0.006
"""Longest time without light before a burst under fingers: if more is left, a longer pulse of the rest delays it."""


class Burst(NamedTuple):
    """Pixels that are drawn one after the other, in this order, from a time on."""

    begin_s: float
    pixels: IntArray


class Refresh(NamedTuple):
    """Part of a page that is drawn next: its frames, and the visiting order of each."""

    sequence: FrameSequence
    visiting_orders: dict[int, IntArray]


def select_bursts(
    tour: IntArray,
    is_touched: BoolArray,
    drawn_s: FloatArray,
    begin_s: float,
    pixel_time_s: float,
    touched_only: bool = False,
) -> list[Burst]:
    """Return the bursts of a page from `begin_s` on, their times relative to it.

    tour: [n] pixels of the page in their visiting order; is_touched: [slots, p] under fingers in the time of each slot;
    drawn_s: [p] start of the last pulse, −infinity without one; pixel_time_s: beam time per pixel
    touched_only: leave the rest of the page dark
    """
    period_s = max(REFRESH_PERIOD_S, pixel_time_s + BURST_S)  # at the end of its light a pixel needs none
    is_touched, due_s = is_touched[:, tour], drawn_s[tour] + period_s - begin_s
    bursts: list[Burst] = []
    now_s, horizon_s = 0.0, len(is_touched) * SLOT_S
    while now_s < horizon_s and len(tour):
        slot = min(int(now_s / SLOT_S + SLOT_ROUNDING), len(is_touched) - 1)
        touched = is_touched[slot]
        due_touched_s, due_rest_s = np.where(touched, due_s, inf), np.where(touched | touched_only, inf, due_s)
        next_s, next_rest_s = float(due_touched_s.min(initial=inf)), float(due_rest_s.min(initial=inf))
        stands_at = int(np.argmax(due_s))  # the pixel that was drawn last
        stands_on_touched = bool(touched[stands_at])
        has_just_drawn = now_s < due_s[stands_at] - period_s + 2.0 * pixel_time_s
        is_in_burst = stands_on_touched and has_just_drawn
        if is_in_burst and next_s <= now_s + pixel_time_s and np.argmin(due_touched_s) != stands_at:
            next_s = now_s  # the burst goes on, though a newer refresh has cut it
        if min(next_s, next_rest_s) > now_s:
            now_s = min(next_s, next_rest_s, (slot + 1) * SLOT_S)  # fingers may have moved by then
            continue
        turn_s, until_s = (due_touched_s, horizon_s) if next_s <= now_s else (due_rest_s, min(next_s, horizon_s))
        count = _count_fitting(until_s - now_s, pixel_time_s)
        count_min = _count_worthwhile(touched, period_s, pixel_time_s) if stands_on_touched else 1
        if count < count_min and until_s < horizon_s:
            now_s = next_s
            continue
        stalest_s = float(turn_s.min())
        goes_on = next_s <= now_s and has_just_drawn and stalest_s > now_s - LATE_S
        first = stands_at + 1 if goes_on else int(np.argmin(turn_s))
        chosen = _take_stretch(turn_s, max(now_s + BURST_S, stalest_s), first, max(1, count))
        bursts.append(Burst(now_s, tour[chosen]))
        due_s[chosen] = now_s + np.arange(len(chosen)) * pixel_time_s + period_s
        now_s += len(chosen) * pixel_time_s
    return bursts


def _count_worthwhile(touched: BoolArray, period_s: float, pixel_time_s: float) -> int:
    """Return how many pixels away from the fingers are worth the mirrors' way before fingers need the beam again."""
    touched_count = int(np.count_nonzero(touched))
    fitting_count = _count_fitting(period_s - touched_count * pixel_time_s, pixel_time_s)
    return min(REST_MIN, len(touched) - touched_count, fitting_count)


def _count_fitting(span_s: float, pixel_time_s: float) -> int:
    """Return how many pixels are drawn in the time between two bursts, s, with the way to them."""
    return int((span_s - WAY_S + max(0.0, pixel_time_s - WASTED_MAX_S)) / pixel_time_s)


def _take_stretch(due_s: FloatArray, until_s: float, first: int, count: int) -> IntArray:
    """Return up to `count` places of a tour that are due until a time, from the place `first` on."""
    due = np.flatnonzero(due_s <= until_s)
    return np.roll(due, -int(np.searchsorted(due, first)))[:count]


def build_refresh(page: TactileFrame, bursts: list[Burst], pixel_time_s: float) -> Refresh:
    """Return the frames that draw bursts in their time.

    A frame draws a pixel once: the heat of its first pulse must be known when its second one is planned.
    """
    frames: list[TactileFrame] = []
    orders: dict[int, IntArray] = {}
    runs: list[tuple[float, list[IntArray]]] = []
    end_s: float = -inf
    for begin_s, order in bursts:
        if begin_s > end_s + pixel_time_s or np.isin(order, np.concatenate(runs[-1][1])).any():
            runs.append((begin_s, []))
        runs[-1][1].append(order)
        end_s = begin_s + len(order) * pixel_time_s
    for begin_s, parts in runs or [(0.0, [np.zeros(0, dtype=np.int64)])]:
        order = np.concatenate(parts)
        orders[len(frames)] = order
        target_m = np.zeros_like(page.target_m)
        target_m[order] = page.target_m[order]
        frames.append(TactileFrame(page.frame_id, begin_s, FRAME_DURATION_S, target_m))
    return Refresh(FrameSequence(tuple(frames)), orders)
