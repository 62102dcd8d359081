"""Omission of pixels and trains by priority, of a long sequence in bulk, pass by pass over all late frames."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame, Train
from optodrive.planning.feasibility.order_search import Orders, OrderSearch
from optodrive.planning.planned_sequence import PlannedSequence


def scale_sequence(sequence: FrameSequence, factor: float) -> FrameSequence:
    """Return the sequence with all heights, and the powers of pulse trains, multiplied by a factor."""
    return FrameSequence(
        tuple(replace(frame, target_m=frame.target_m * factor) for frame in sequence.frames),
        tuple(_scale_train(train, factor) for train in sequence.trains),
    )


def _scale_train(train: Train, factor: float) -> Train:
    if isinstance(train, PulseTrain):
        return replace(train, power_w=train.power_w * factor)
    peak_to_peak_m = None if train.peak_to_peak_m is None else train.peak_to_peak_m * factor
    return replace(train, target_m=train.target_m * factor, peak_to_peak_m=peak_to_peak_m)


def stretch_sequence(sequence: FrameSequence, time_factor: float) -> FrameSequence:
    """Return the sequence with all times multiplied by a factor. The pulse widths of pulse trains stay."""
    return FrameSequence(
        tuple(
            replace(frame, show_at_s=frame.show_at_s * time_factor, duration_s=frame.duration_s * time_factor)
            for frame in sequence.frames
        ),
        tuple(_stretch_train(train, time_factor) for train in sequence.trains),
    )


def _stretch_train(train: Train, time_factor: float) -> Train:
    start_s, duration_s = train.start_s * time_factor, train.duration_s * time_factor
    if isinstance(train, HeightTrain):
        return replace(train, start_s=start_s, duration_s=duration_s, period_s=train.period_s * time_factor)
    # Stretch the period instead of the gap alone, so that the pulses of two trains do not overlap.
    gap_s = (train.pulse_width_s + train.gap_s) * time_factor - train.pulse_width_s
    return replace(train, start_s=start_s, duration_s=duration_s, gap_s=gap_s)


def omit_pixels(sequence: FrameSequence, omitted: Mapping[int, Collection[int]]) -> FrameSequence:
    """Return the sequence without some pixels of its frames and some of its trains.

    omitted: pixels by source; sources number the frames, then the trains. A train is omitted whole.
    """
    return FrameSequence(
        tuple(_omit_from_frame(frame, omitted.get(source, ())) for source, frame in enumerate(sequence.frames)),
        tuple(train for k, train in enumerate(sequence.trains) if len(sequence.frames) + k not in omitted),
    )


def _omit_from_frame(frame: TactileFrame, pixels: Collection[int]) -> TactileFrame:
    if not pixels:
        return frame
    target_m = frame.target_m.copy()
    target_m[np.array(sorted(pixels))] = 0.0
    return replace(frame, target_m=target_m)


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
        # Trimmed pixels go first: without them no cap reduces anything.
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
        # The lowest target was omitted last, and comes back first: it needs the least.
        for pixel in reversed(pixels):
            if search.is_exhausted:
                return omitted, best
            candidate = {key: tuple(one for one in omitted[key] if (key, one) != (source, pixel)) for key in omitted}
            orders = search.find_orders(omit_pixels(sequence, candidate))
            if orders is not None:
                omitted, best = candidate, orders
    return omitted, best


EXHAUSTIVE_PIXELS_MAX = 6
"""Pixels up to which every subset of a frame is tried; a larger frame loses its highest targets first."""
PLANS_PER_SOURCE = 12
"""Plans per source below which all frames are reduced in bulk."""


def reduce_sequence(search: OrderSearch, sequence: FrameSequence) -> tuple[OmittedPixels, Orders] | None:
    """Find pixels to omit so that an infeasible sequence fits.

    Frames and trains are accepted in order of priority, the earlier first among equals. A frame that does not fit
    beside those accepted before loses as few pixels as possible; a train is omitted whole.

    Returns the omitted pixels by source and the visiting orders of the rest, or None if no part fits.
    """
    sources = len(sequence.frames) + len(sequence.trains)
    priorities = {frame.priority for frame in sequence.frames} | {train.priority for train in sequence.trains}
    # Bulk knows no priorities, and frame by frame would need more plans than are left.
    if len(priorities) == 1 and search.plans_max < PLANS_PER_SOURCE * sources:
        reduced = reduce_in_bulk(search, sequence)
        if reduced is not None:
            return reduced
    return _Reducer(search, sequence).run()


class _Reducer:
    """One pass over frames and trains by priority."""

    def __init__(self, search: OrderSearch, sequence: FrameSequence) -> None:
        self._search = search
        self._sequence = sequence
        self._source_pixels = _list_source_pixels(sequence)
        self._omitted: OmittedPixels = dict(self._source_pixels)
        self._orders: Orders | None = None

    def run(self) -> tuple[OmittedPixels, Orders] | None:
        """Return the omitted pixels and the visiting orders of the rest, or None if no part fits."""
        remaining, whole_may_fit = sort_by_priority(self._sequence), False
        while remaining and not self._search.is_exhausted:
            accepted = self._accept_whole_sources(remaining, whole_may_fit)
            remaining = remaining[accepted:]
            if remaining:
                self._accept_reduced_frame(remaining[0])
                remaining, whole_may_fit = remaining[1:], True
        shows_anything = any(
            set(pixels) - set(self._omitted.get(source, ())) for source, pixels in self._source_pixels.items()
        )
        return (self._omitted, self._orders) if self._orders is not None and shows_anything else None

    def _try_omitted(self, omitted: OmittedPixels) -> bool:
        """Return whether the sequence fits without these pixels, and keep the result if it does."""
        orders = self._search.find_orders(omit_pixels(self._sequence, omitted))
        if orders is None:
            return False
        self._omitted, self._orders = omitted, orders
        return True

    def _accept_whole_sources(self, remaining: Sequence[int], whole_may_fit: bool) -> int:
        """Accept as many of the remaining sources as fit whole, by bisection, and return their number."""
        before = self._omitted

        def fits(count: int) -> bool:
            accepted = set(remaining[:count])
            return self._try_omitted({source: pixels for source, pixels in before.items() if source not in accepted})

        low, high = 0, len(remaining)
        if whole_may_fit and fits(high):
            return high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if fits(middle) else (low, middle)
        return low

    def _accept_reduced_frame(self, source: int) -> None:
        """Accept a frame without the fewest pixels. Omit all of it if no part fits."""
        if source >= len(self._sequence.frames):
            return
        pixels = self._source_pixels[source]
        if len(pixels) <= EXHAUSTIVE_PIXELS_MAX:
            any(self._try_omitted(self._omitted | {source: omitted}) for omitted in _generate_omissions(pixels))
            return
        infeasible = self._find_infeasible_pixels(source, pixels)
        candidates = [pixel for pixel in pixels if pixel not in infeasible]
        before, low, high = self._omitted, 0, len(candidates)
        if infeasible and self._try_omitted(before | {source: infeasible}):
            return
        while high - low > 1:
            middle = (low + high) // 2
            fits = self._try_omitted(before | {source: infeasible + tuple(candidates[:middle])})
            low, high = (low, middle) if fits else (middle, high)

    def _find_infeasible_pixels(self, source: int, pixels: tuple[int, ...]) -> tuple[int, ...]:
        """Return the pixels of a frame that violate a cap or are unreachable, found one by one."""
        infeasible: tuple[int, ...] = ()
        while True:
            violation = self._search.find_violation(omit_pixels(self._sequence, self._omitted | {source: infeasible}))
            if (
                violation is None
                or violation.reason == "deadline"
                or violation.pixel not in set(pixels) - set(infeasible)
            ):
                return infeasible
            infeasible += (violation.pixel,)


def sort_by_priority(sequence: FrameSequence) -> list[int]:
    """Return the sources of frames and trains, the highest priority first, the earlier first among equals."""
    keys = [(-frame.priority, frame.show_at_s) for frame in sequence.frames]
    keys += [(-train.priority, train.start_s) for train in sequence.trains]
    return sorted(range(len(keys)), key=lambda source: keys[source])


def _list_source_pixels(sequence: FrameSequence) -> OmittedPixels:
    """Return the driven pixels of every source, the highest target first."""
    pixels = {source: sort_pixels_by_height(frame) for source, frame in enumerate(sequence.frames)}
    first = len(sequence.frames)
    return pixels | {first + k: (train.pixel,) for k, train in enumerate(sequence.trains)}


def _generate_omissions(pixels: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Generate all proper non-empty subsets to omit, smaller subsets first, highest targets first."""
    for count in range(1, len(pixels)):
        yield from combinations(pixels, count)
