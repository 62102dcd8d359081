"""A long sequence thinned all at once: what is too much leaves every late frame, round by round; some comes back."""

from collections.abc import Callable

import numpy as np

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.feasibility.order_search import Orders, Trials
from optodrive.planning.feasibility.sequence_edits import without
from optodrive.planning.pipeline import Prepared

ROUNDS = 12

Left = dict[int, tuple[int, ...]]
"""Pixels left out, by source."""


def in_rounds(trials: Trials, sequence: FrameSequence) -> tuple[Left, Orders] | None:
    """Pixels left out, and orders for the rest; None where it does not come to fit in a few rounds."""
    left: Left = {}
    for _ in range(ROUNDS):
        prepared = trials.planned(without(sequence, left))
        if prepared is None:
            return None
        more = _too_much(prepared, trials.tick)
        if not more:
            found = trials.found(prepared.sequence)
            return None if found is None else _put_back(trials, sequence, left, found)
        left = {source: left.get(source, ()) + more.get(source, ()) for source in left | more}
    return None


def tallest_first(frame: TactileFrame) -> tuple[int, ...]:
    """The pixels a frame drives."""
    driven = np.flatnonzero(frame.target_m > 0)
    return tuple(driven[np.argsort(-frame.target_m[driven], kind="stable")].tolist())


def _too_much(prepared: Prepared, tick: Callable[[], None]) -> Left:
    """What the frames of a plan that does not fit must lose at the least, as far as one plan shows it."""
    plan, before_s = prepared.plan, 0.0
    more: Left = {}
    for timing in prepared.frames:
        tick()
        rows = np.flatnonzero(plan.source == timing.source)
        out = [int(pixel) for pixel in plan.pixel[rows[plan.reason[rows] != ""]]]
        over_s = timing.finished_s - max(timing.show_at_s, before_s) - (timing.due_s - timing.show_at_s)
        before_s = timing.finished_s
        cost_s = dict(zip(plan.pixel[rows].tolist(), (plan.width_s + plan.settle_s)[rows].tolist(), strict=True))
        for pixel in tallest_first(prepared.sequence.frames[timing.source]):
            if over_s <= sum(cost_s.get(one, 0.0) for one in out):
                break
            if pixel in cost_s and pixel not in out:
                out.append(pixel)
        # A frame that is late only because others were comes in time without them, or else in a later round.
        if timing.late_s > 0 and not out and not more:
            out = list(tallest_first(prepared.sequence.frames[timing.source])[:1])
        if out:
            more[timing.source] = tuple(out)
    return more


def _put_back(trials: Trials, sequence: FrameSequence, left: Left, best: Orders) -> tuple[Left, Orders]:
    """Show again what fits after all, the lowest first, while plans may be tried."""
    for source, pixels in list(left.items()):
        for pixel in reversed(pixels):
            if trials.spent:
                return left, best
            fewer = {key: tuple(one for one in left[key] if (key, one) != (source, pixel)) for key in left}
            orders = trials.found(without(sequence, fewer))
            if orders is not None:
                left, best = fewer, orders
    return left, best
