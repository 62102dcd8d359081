"""Pixels of a standing page whose turn it is, those under fingers first.

Theory of operation. Pixels fall within a fraction of a second, and a beam raises one after another, so of a page of
some hundred dots each gets its turn about once a second, where touch wants twenty. A finger touches few of them. Every
pixel of the page is due REFRESH_PERIOD_S after its last pulse, and nothing is drawn before: a page of few dots takes no
more energy than its rate needs. As soon as a pixel under a finger is due, all of them that are due within BURST_S are
drawn in one burst, those without light for the longest time first. The beam time until the next of them is due goes to
the rest of the page in the same way, unless that is too short for the mirrors to be worth the way, which heats them. It
is worth it for fewer pixels if more pulses never fit between two bursts under fingers, as wide ones do.

A burst takes a short path. Bursts without a pause between them are one frame with a visiting order of its own.
"""

from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import PixelLayout
from optodrive.planning.scheduler.visiting_path import compute_visiting_order
from optodrive.planning.stimuli.frame_json import FRAME_DURATION_S

REFRESH_PERIOD_S = 0.04
"""Time from one pulse of a pixel to its next turn. Touch tells less than 20 per second from a standing dot."""
BURST_S = 0.012
BURST_MAX_S = 0.024
"""Longest burst under fingers. A newer refresh replaces the end of its path, which would leave one finger dark."""
REST_MIN = 6
"""Pixels away from the fingers that are worth the mirrors' way between two bursts under fingers."""
SLOT_S = 0.01
"""Light is planned for a number of slots, in each of which the places of the fingers are taken as fixed."""


class Burst(NamedTuple):
    """Pixels that are drawn one after the other from a time on."""

    begin_s: float
    pixels: IntArray


class Refresh(NamedTuple):
    """Part of a page that is drawn next: its frames, and the visiting order of each."""

    sequence: FrameSequence
    visiting_orders: dict[int, IntArray]


def select_bursts(
    target_m: FloatArray, is_touched: BoolArray, drawn_s: FloatArray, begin_s: float, pixel_time_s: float
) -> list[Burst]:
    """Return the bursts of a page from `begin_s` on, their times relative to it.

    target_m: [p] the page; is_touched: [slots, p] under fingers in the time of each slot; drawn_s: [p] start of the
    last pulse, −infinity without one; pixel_time_s: beam time per pixel
    """
    page = np.flatnonzero(target_m > 0.0)
    is_touched, due_s = is_touched[:, page], drawn_s[page] + REFRESH_PERIOD_S - begin_s
    bursts: list[Burst] = []
    now_s, horizon_s = 0.0, len(is_touched) * SLOT_S
    while now_s < horizon_s:
        touched = is_touched[min(int(now_s / SLOT_S), len(is_touched) - 1)]
        due_touched_s, due_rest_s = np.where(touched, due_s, inf), np.where(touched, inf, due_s)
        next_s = float(due_touched_s.min(initial=inf))
        if next_s <= now_s:
            span_s = min(BURST_MAX_S, horizon_s - now_s)
            chosen = _take_oldest(due_touched_s, now_s + BURST_S, span_s, pixel_time_s)
        else:
            chosen = _take_oldest(due_rest_s, now_s, min(next_s, horizon_s) - now_s, pixel_time_s)
            if len(chosen) < (1 if next_s >= horizon_s else _count_worthwhile(touched, pixel_time_s)):
                now_s = max(min(next_s, float(due_rest_s[due_rest_s > now_s].min(initial=inf))), now_s + pixel_time_s)
                continue
        bursts.append(Burst(now_s, page[chosen]))
        due_s[chosen] = now_s + np.arange(len(chosen)) * pixel_time_s + REFRESH_PERIOD_S
        now_s += len(chosen) * pixel_time_s
    return bursts


def _count_worthwhile(touched: BoolArray, pixel_time_s: float) -> int:
    """Return how many pixels away from the fingers are worth the mirrors' way before fingers need the beam again."""
    touched_count = int(np.count_nonzero(touched))
    between_s = REFRESH_PERIOD_S - touched_count * pixel_time_s
    return max(1, min(REST_MIN, len(touched) - touched_count, int(between_s / pixel_time_s)))


def _take_oldest(due_s: FloatArray, until_s: float, span_s: float, pixel_time_s: float) -> IntArray:
    """Return the pixels that are due until a time, as many as fit a span, the longest due first."""
    due = np.flatnonzero(due_s <= until_s)
    return due[np.argsort(due_s[due], kind="stable")][: max(1, int(span_s / pixel_time_s))]


def build_refresh(page: TactileFrame, bursts: list[Burst], layout: PixelLayout, pixel_time_s: float) -> Refresh:
    """Return the frames that draw bursts in their time.

    A frame draws a pixel once: the heat of its first pulse must be known when its second one is planned.
    """
    frames: list[TactileFrame] = []
    orders: dict[int, IntArray] = {}
    runs: list[tuple[float, list[IntArray]]] = []
    end_s: float = -inf
    origin: int | None = None
    for begin_s, pixels in bursts:
        order = compute_visiting_order(pixels, layout.row, layout.column, layout.x_m, layout.y_m, origin)
        if begin_s > end_s + pixel_time_s or np.isin(order, np.concatenate(runs[-1][1])).any():
            runs.append((begin_s, []))
        runs[-1][1].append(order)
        end_s, origin = begin_s + len(pixels) * pixel_time_s, int(order[-1])
    for begin_s, parts in runs or [(0.0, [np.zeros(0, dtype=np.int64)])]:
        order = np.concatenate(parts)
        orders[len(frames)] = order
        target_m = np.zeros_like(page.target_m)
        target_m[order] = page.target_m[order]
        frames.append(TactileFrame(page.frame_id, begin_s, FRAME_DURATION_S, target_m))
    return Refresh(FrameSequence(tuple(frames)), orders)
