"""Which pixels and trains are left out so that the rest fits: the more important stay, and of a frame the most."""

from collections.abc import Iterator, Sequence
from itertools import combinations

from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.bulk_reduction import OmittedPixels, reduce_in_bulk, sort_pixels_by_height
from optodrive.planning.feasibility.order_search import Orders, OrderSearch
from optodrive.planning.feasibility.sequence_edits import omit_pixels

EXHAUSTIVE_PIXELS_MAX = 6
"""In a frame of so many pixels at most every set is tried; of a larger one the tallest go first."""
PLANS_PER_SOURCE = 12
"""Where there may be fewer plans, all frames are thinned at once, in rounds."""


def reduce_sequence(search: OrderSearch, sequence: FrameSequence) -> tuple[OmittedPixels, Orders] | None:
    """Pixels left out, by source, of a sequence that does not fit; and orders for the rest. None where nothing fits.

    Frames and trains are admitted in order of priority, the earlier first among equals; from what does not fit beside
    those before it, a frame's pixels are left out, the fewest, and a train whole.
    """
    sources = len(sequence.frames) + len(sequence.trains)
    priorities = {frame.priority for frame in sequence.frames} | {train.priority for train in sequence.trains}
    if len(priorities) == 1 and search.plans_max < PLANS_PER_SOURCE * sources:
        reduced = reduce_in_bulk(search, sequence)
        if reduced is not None:
            return reduced
    return _Reducer(search, sequence).run()


class _Reducer:
    """One walk through frames and trains by priority."""

    def __init__(self, search: OrderSearch, sequence: FrameSequence) -> None:
        self._search = search
        self._sequence = sequence
        self._source_pixels = _list_source_pixels(sequence)
        self._omitted: OmittedPixels = dict(self._source_pixels)
        self._orders: Orders | None = None

    def run(self) -> tuple[OmittedPixels, Orders] | None:
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
        orders = self._search.find_orders(omit_pixels(self._sequence, omitted))
        if orders is None:
            return False
        self._omitted, self._orders = omitted, orders
        return True

    def _accept_whole_sources(self, remaining: Sequence[int], whole_may_fit: bool) -> int:
        """Admit as many of the rest as fit whole, by halving; how many."""
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
        """Admit a frame less the fewest pixels; leaves all out where nothing of it fits."""
        if source >= len(self._sequence.frames):
            return
        pixels = self._source_pixels[source]
        if len(pixels) <= EXHAUSTIVE_PIXELS_MAX:
            any(self._try_omitted(self._omitted | {source: left}) for left in _generate_omissions(pixels))
            return
        infeasible = self._find_infeasible_pixels(source, pixels)
        tallest = [pixel for pixel in pixels if pixel not in infeasible]
        before, low, high = self._omitted, 0, len(tallest)
        if infeasible and self._try_omitted(before | {source: infeasible}):
            return
        while high - low > 1:
            middle = (low + high) // 2
            fits = self._try_omitted(before | {source: infeasible + tuple(tallest[:middle])})
            low, high = (low, middle) if fits else (middle, high)

    def _find_infeasible_pixels(self, source: int, pixels: tuple[int, ...]) -> tuple[int, ...]:
        """Those pixels of a frame that a cap or their reach does not allow, one after the other."""
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
    """Sources of frames and trains, the most important first, the earlier first among equals."""
    keys = [(-frame.priority, frame.show_at_s) for frame in sequence.frames]
    keys += [(-train.priority, train.start_s) for train in sequence.trains]
    return sorted(range(len(keys)), key=lambda source: keys[source])


def _list_source_pixels(sequence: FrameSequence) -> OmittedPixels:
    """What each source drives, the tallest first."""
    pixels = {source: sort_pixels_by_height(frame) for source, frame in enumerate(sequence.frames)}
    first = len(sequence.frames)
    return pixels | {first + k: (train.pixel,) for k, train in enumerate(sequence.trains)}


def _generate_omissions(pixels: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """All sets to leave out but none and everything: the smaller first, with the taller first."""
    for count in range(1, len(pixels)):
        yield from combinations(pixels, count)
