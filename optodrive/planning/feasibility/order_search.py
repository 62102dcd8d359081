"""Plans tried from one heat and budget, so many at most: by the planner's order, or by any order of a small sequence.

What is exact: every order of every frame's pixels is tried, each pulse as early as it may come, a train's pulse before
any pulse that would make it late. What is not tried is waiting on purpose: the less heat is left, the longer a pulse,
so that hardly ever pays; but the gas lags by some milliseconds, and within them it may.
"""

from collections.abc import Callable, Mapping
from math import factorial, prod

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, PulsePlan
from optodrive.core.types.stimuli import FrameSequence, HeightTrain
from optodrive.physics.thermal_state import Heat
from optodrive.planning.feasibility.violation import Breach, deadlines_s, first_breach, least_s, no_order_helps
from optodrive.planning.limiter.limiter import limit
from optodrive.planning.pipeline import ROUNDING_S, Display, Prepared, beyond_reach, mirrors_rest, prepare
from optodrive.planning.scheduler.scheduler import Scheduler

ORDERS_MAX = 14_000
"""A sequence with so many orders at most is small: three frames of four pixels have 13,824."""

MICROSECOND_S = 1e-6

Orders = Mapping[int, IntArray]
"""By source, the order in which a frame's driven pixels are visited."""


class _SpentError(Exception):
    """So many plans were tried as may be."""


class Trials:
    """Tries plans. plans: how many so far; spent: whether one more was wanted than plans_max; tick: shows progress.

    What is found is given as orders by source, with which `prepare` makes the plan that was tried; the planner's own
    where none is given.
    """

    def __init__(
        self, display: Display, heat: Heat, budget: BudgetState, tick: Callable[[], None], plans_max: int
    ) -> None:
        self.plans = 0
        self.plans_max = plans_max
        self.spent = False
        self._display = display
        self._heat = heat
        self._budget = budget
        self.tick = tick

    def found(self, sequence: FrameSequence) -> Orders | None:
        """Orders with which the sequence fits, the planner's own or others; None where none were found."""
        try:
            breach = self._breach(sequence)
            if breach is None:
                return {}
            few = orders_count(sequence) <= ORDERS_MAX
            return self._search(sequence) if few and not self.proven(sequence, breach)[0] else None
        except _SpentError:
            self.spent = True
            return None

    def searched(self, sequence: FrameSequence) -> Orders | None:
        """Orders with which a small sequence fits; None where there are none, unless spent."""
        try:
            return self._search(sequence)
        except _SpentError:
            self.spent = True
            return None

    def broken(self, sequence: FrameSequence) -> Breach | None:
        """What breaks the plan by the planner's order; None where nothing does, or no more plans may be tried."""
        try:
            return self._breach(sequence)
        except _SpentError:
            self.spent = True
            return None

    def planned(self, sequence: FrameSequence) -> Prepared | None:
        """The plan by the planner's order, late and trimmed as it may be; None out of reach, or when spent."""
        if beyond_reach(self._display, sequence) is not None:
            return None
        if self.plans >= self.plans_max:
            self.spent = True
            return None
        self.plans += 1
        try:
            return prepare(self._display, sequence, self._heat, self._budget, "trim", lambda _share: self.tick())
        except InputError:  # a train by height has no such cycle
            return None

    def proven(self, sequence: FrameSequence, breach: Breach) -> tuple[bool, float | None]:
        """Whether no order can mend a breach, and the beam time that its frame takes at the least, s, if known."""
        if no_order_helps(breach, sequence):
            return True, None
        if breach.reason != "deadline":
            return False, None
        frame = sequence.frames[breach.source]
        lead_s = self._display.machine.moves.lead_us * 1e-6
        least = least_s(self._display, sequence, self._heat, breach.source, lead_s)
        # The beam counts from a whole microsecond, a deadline does not.
        return least is not None and least > frame.duration_s + MICROSECOND_S + ROUNDING_S, least

    def _breach(self, sequence: FrameSequence, orders: Orders | None = None) -> Breach | None:
        """What breaks the plan by these orders first; the planner's own where None."""
        beyond = beyond_reach(self._display, sequence) if orders is None else None
        if beyond is not None:
            return Breach("reach", beyond[0], beyond[1])
        if self.plans >= self.plans_max:
            raise _SpentError
        self.plans += 1
        try:
            # Most orders end early for want of time, and the limiter takes four times as long to ask.
            return self._walked(sequence, orders, limited=False) or self._walked(sequence, orders, limited=True)
        except InputError:  # as scaled or stretched, a train by height has no such cycle
            source, train = next((k, t) for k, t in enumerate(sequence.trains) if isinstance(t, HeightTrain))
            return Breach("reach", len(sequence.frames) + source, train.pixel)

    def _walked(self, sequence: FrameSequence, orders: Orders | None, limited: bool) -> Breach | None:
        """The plan piece by piece up to its first breach, through the limiter or as if there were none."""
        machine, at_rest = self._display.machine, self._display.heat_at_rest
        scheduler = Scheduler(machine, sequence, at_rest, tick=self.tick, orders=orders)
        due_s = deadlines_s(sequence, scheduler.lead_us * 1e-6)
        heat, state = self._heat.copy(), self._budget
        pieces = scheduler.pieces(heat)
        asked = next(pieces, None)
        while asked is not None:
            self.tick()
            piece: PulsePlan = asked
            if limited:
                rest = mirrors_rest(self._display, asked, state, len(sequence.frames))
                if rest is not None:
                    asked = pieces.send(rest)
                    continue
                piece, state = limit(asked, state, self._display.budget)
            breach = first_breach(piece, due_s)
            if breach is not None:
                return breach
            heat.pulses(piece.pixel, piece.start_s, piece.width_s, piece.power_w, self.tick)
            asked = next(pieces, None)
        return None

    def _search(self, sequence: FrameSequence) -> Orders | None:
        """Orders one after the other, depth first: all that begin as one did up to where it broke are passed over."""
        driven = [np.flatnonzero(frame.target_m > 0) for frame in sequence.frames]
        ranks = [list(range(len(pixels))) for pixels in driven]
        while True:
            orders = {source: pixels[ranks[source]] for source, pixels in enumerate(driven)}
            breach = self._breach(sequence, orders)
            if breach is None:
                return orders
            if no_order_helps(breach, sequence) or not _advance(ranks, *_broken_at(breach, orders, ranks)):
                return None


def orders_count(sequence: FrameSequence) -> int:
    """In how many orders the pixels of all frames can be visited; beyond counting where pixels come several times."""
    if any(frame.together for frame in sequence.frames):
        return ORDERS_MAX + 1
    return prod(factorial(int(np.count_nonzero(frame.target_m > 0))) for frame in sequence.frames)


def _broken_at(breach: Breach, orders: Orders, ranks: list[list[int]]) -> tuple[int, int]:
    """The frame and the place in its order up to which a breach is decided; for a train's pulse, the very last."""
    if breach.source < len(ranks):
        return breach.source, orders[breach.source].tolist().index(breach.pixel)
    return len(ranks) - 1, len(ranks[-1]) - 1 if ranks else 0


def _advance(ranks: list[list[int]], source: int, place: int) -> bool:
    """To the next orders that differ up to this place of this frame, in place; False where there are no more."""
    for later in ranks[source + 1 :]:
        later.sort()
    while source >= 0:
        if _next(ranks[source], place):
            return True
        ranks[source].sort()
        source -= 1
        place = len(ranks[source]) - 1
    return False


def _next(rank: list[int], place: int) -> bool:
    """The next permutation that differs up to a place, in place; False where there is none."""
    rank[place + 1 :] = sorted(rank[place + 1 :], reverse=True)
    for k in range(len(rank) - 2, -1, -1):
        if rank[k] < rank[k + 1]:
            other = max(m for m in range(k + 1, len(rank)) if rank[m] > rank[k])
            rank[k], rank[other] = rank[other], rank[k]
            rank[k + 1 :] = rank[:k:-1]
            return True
    return False
