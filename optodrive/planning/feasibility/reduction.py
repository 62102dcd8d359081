"""Which pixels and trains are left out so that the rest fits: the more important stay, and of a frame the most."""

from collections.abc import Iterator, Sequence
from itertools import combinations

from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.bulk_reduction import Left, in_rounds, tallest_first
from optodrive.planning.feasibility.order_search import Orders, Trials
from optodrive.planning.feasibility.sequence_edits import without

EVERY_SUBSET = 6
"""In a frame of so many pixels at most every set is tried; of a larger one the tallest go first."""
PLANS_A_SOURCE = 12
"""Where there may be fewer plans, all frames are thinned at once, in rounds."""


def thinned(trials: Trials, sequence: FrameSequence) -> tuple[Left, Orders] | None:
    """Pixels left out, by source, of a sequence that does not fit; and orders for the rest. None where nothing fits.

    Frames and trains are admitted in order of priority, the earlier first among equals; from what does not fit beside
    those before it, a frame's pixels are left out, the fewest, and a train whole.
    """
    sources = len(sequence.frames) + len(sequence.trains)
    priorities = {frame.priority for frame in sequence.frames} | {train.priority for train in sequence.trains}
    if len(priorities) == 1 and trials.plans_max < PLANS_A_SOURCE * sources:
        found = in_rounds(trials, sequence)
        if found is not None:
            return found
    return _Thinning(trials, sequence).result()


class _Thinning:
    """One walk through frames and trains by priority."""

    def __init__(self, trials: Trials, sequence: FrameSequence) -> None:
        self._trials = trials
        self._sequence = sequence
        self._pixels = _pixels(sequence)
        self._left: Left = dict(self._pixels)
        self._best: Orders | None = None

    def result(self) -> tuple[Left, Orders] | None:
        rest, whole_fits = by_priority(self._sequence), False
        while rest and not self._trials.spent:
            fitting = self._most(rest, whole_fits)
            rest = rest[fitting:]
            if rest:
                self._fewest(rest[0])
                rest, whole_fits = rest[1:], True
        shown = any(set(pixels) - set(self._left.get(source, ())) for source, pixels in self._pixels.items())
        return (self._left, self._best) if self._best is not None and shown else None

    def _fits(self, left: Left) -> bool:
        orders = self._trials.found(without(self._sequence, left))
        if orders is None:
            return False
        self._left, self._best = left, orders
        return True

    def _most(self, rest: Sequence[int], whole_may_fit: bool) -> int:
        """Admit as many of the rest as fit whole, by halving; how many."""
        before = self._left

        def fits(count: int) -> bool:
            admitted = set(rest[:count])
            return self._fits({source: pixels for source, pixels in before.items() if source not in admitted})

        low, high = 0, len(rest)
        if whole_may_fit and fits(high):
            return high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if fits(middle) else (low, middle)
        return low

    def _fewest(self, source: int) -> None:
        """Admit a frame less the fewest pixels; leaves all out where nothing of it fits."""
        if source >= len(self._sequence.frames):
            return
        pixels = self._pixels[source]
        if len(pixels) <= EVERY_SUBSET:
            any(self._fits(self._left | {source: left}) for left in _subsets(pixels))
            return
        dropped = self._hot(source, pixels)
        tallest = [pixel for pixel in pixels if pixel not in dropped]
        before, low, high = self._left, 0, len(tallest)
        if dropped and self._fits(before | {source: dropped}):
            return
        while high - low > 1:
            middle = (low + high) // 2
            fit = self._fits(before | {source: dropped + tuple(tallest[:middle])})
            low, high = (low, middle) if fit else (middle, high)

    def _hot(self, source: int, pixels: tuple[int, ...]) -> tuple[int, ...]:
        """Those pixels of a frame that a cap or their reach does not allow, one after the other."""
        dropped: tuple[int, ...] = ()
        while True:
            breach = self._trials.broken(without(self._sequence, self._left | {source: dropped}))
            if breach is None or breach.reason == "deadline" or breach.pixel not in set(pixels) - set(dropped):
                return dropped
            dropped += (breach.pixel,)


def by_priority(sequence: FrameSequence) -> list[int]:
    """Sources of frames and trains, the most important first, the earlier first among equals."""
    keys = [(-frame.priority, frame.show_at_s) for frame in sequence.frames]
    keys += [(-train.priority, train.start_s) for train in sequence.trains]
    return sorted(range(len(keys)), key=lambda source: keys[source])


def _pixels(sequence: FrameSequence) -> Left:
    """What each source drives, the tallest first."""
    pixels = {source: tallest_first(frame) for source, frame in enumerate(sequence.frames)}
    first = len(sequence.frames)
    return pixels | {first + k: (train.pixel,) for k, train in enumerate(sequence.trains)}


def _subsets(pixels: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """All sets to leave out but none and everything: the smaller first, with the taller first."""
    for count in range(1, len(pixels)):
        yield from combinations(pixels, count)
