"""Reduction of a long sequence in bulk, pass by pass over all late frames."""

from collections.abc import Callable

import numpy as np

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.feasibility.order_search import Orders, OrderSearch
from optodrive.planning.feasibility.sequence_edits import omit_pixels
from optodrive.planning.planned_sequence import PlannedSequence

PASSES_MAX = 12
"""Planning passes after which the bulk reduction gives up."""

OmittedPixels = dict[int, tuple[int, ...]]
"""Omitted pixels by source."""


def reduce_in_bulk(search: OrderSearch, sequence: FrameSequence) -> tuple[OmittedPixels, Orders] | None:
    """Reduce all frames pass by pass until the sequence fits.

    Returns the omitted pixels and the visiting orders of the rest, or None if the sequence still does not fit after
    PASSES_MAX passes.
    """
    omitted: OmittedPixels = {}
    for _ in range(PASSES_MAX):
        prepared = search.plan(omit_pixels(sequence, omitted))
        if prepared is None:
            return None
        excess = _find_excess_pixels(prepared, search.on_progress)
        if not excess:
            orders = search.find_orders(prepared.sequence)
            return None if orders is None else _restore_pixels(search, sequence, omitted, orders)
        omitted = {source: omitted.get(source, ()) + excess.get(source, ()) for source in omitted | excess}
    return None


def sort_pixels_by_height(frame: TactileFrame) -> tuple[int, ...]:
    """Return the driven pixels of a frame, the highest target first."""
    driven = np.flatnonzero(frame.target_m > 0)
    return tuple(driven[np.argsort(-frame.target_m[driven], kind="stable")].tolist())


def _find_excess_pixels(prepared: PlannedSequence, on_progress: Callable[[], None]) -> OmittedPixels:
    """Return the pixels that the late frames of a plan must lose at least, as far as this plan shows it."""
    plan, previous_end_s = prepared.plan, 0.0
    excess: OmittedPixels = {}
    for timing in prepared.frames:
        on_progress()
        rows = np.flatnonzero(plan.source == timing.source)
        omitted = [int(pixel) for pixel in plan.pixel[rows[plan.reason[rows] != ""]]]
        overrun_s = timing.end_s - max(timing.show_at_s, previous_end_s) - (timing.deadline_s - timing.show_at_s)
        previous_end_s = timing.end_s
        cost_s = dict(zip(plan.pixel[rows].tolist(), (plan.width_s + plan.settling_s)[rows].tolist(), strict=True))
        for pixel in sort_pixels_by_height(prepared.sequence.frames[timing.source]):
            if overrun_s <= sum(cost_s.get(one, 0.0) for one in omitted):
                break
            if pixel in cost_s and pixel not in omitted:
                omitted.append(pixel)
        # A frame delayed only by earlier frames is on time once those are reduced, or is reduced in a later pass.
        if timing.late_s > 0 and not omitted and not excess:
            omitted = list(sort_pixels_by_height(prepared.sequence.frames[timing.source])[:1])
        if omitted:
            excess[timing.source] = tuple(omitted)
    return excess


def _restore_pixels(
    search: OrderSearch, sequence: FrameSequence, omitted: OmittedPixels, best: Orders
) -> tuple[OmittedPixels, Orders]:
    """Restore omitted pixels that fit after all, the lowest target first, until the search is exhausted."""
    for source, pixels in list(omitted.items()):
        for pixel in reversed(pixels):
            if search.is_exhausted:
                return omitted, best
            candidate = {key: tuple(one for one in omitted[key] if (key, one) != (source, pixel)) for key in omitted}
            orders = search.find_orders(omit_pixels(sequence, candidate))
            if orders is not None:
                omitted, best = candidate, orders
    return omitted, best
