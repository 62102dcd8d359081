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
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.batch_limiter import BatchLimiter
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.violation import (
    Violation,
    beam_lower_bound_s,
    deadlines_s,
    find_first_violation,
    is_order_independent,
)
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.planned_sequence import TIME_TOLERANCE_S, PlannedSequence
from optodrive.planning.scheduler.scheduler import Scheduler
from optodrive.planning.sequence_checks import first_unreachable

ORDERS_MAX = 14_000
"""A sequence with so many orders at most is small: three frames of four pixels have 13,824."""

MICROSECOND_S = 1e-6

Orders = Mapping[int, IntArray]
"""By source, the order in which a frame's driven pixels are visited."""


class _PlanLimitError(Exception):
    """So many plans were tried as may be."""


class OrderSearch:
    """Tries plans. plans: how many so far; spent: whether one more was wanted than plans_max; tick: shows progress.

    What is found is given as orders by source, with which `prepare` makes the plan that was tried; the planner's own
    where none is given.
    """

    def __init__(
        self,
        display: DisplayModel,
        heat: ThermalState,
        budget: BudgetState,
        on_progress: Callable[[], None],
        plans_max: int,
    ) -> None:
        self.plans_tried = 0
        self.plans_max = plans_max
        self.is_exhausted = False
        self._display = display
        self._heat = heat
        self._budget = budget
        self.on_progress = on_progress

    def find_orders(self, sequence: FrameSequence) -> Orders | None:
        """Orders with which the sequence fits, the planner's own or others; None where none were found."""
        try:
            violation = self._try_orders(sequence)
            if violation is None:
                return {}
            is_small = count_orders(sequence) <= ORDERS_MAX
            return (
                self._search_depth_first(sequence)
                if is_small and not self.prove_infeasible(sequence, violation)[0]
                else None
            )
        except _PlanLimitError:
            self.is_exhausted = True
            return None

    def search_all_orders(self, sequence: FrameSequence) -> Orders | None:
        """Orders with which a small sequence fits; None where there are none, unless spent."""
        try:
            return self._search_depth_first(sequence)
        except _PlanLimitError:
            self.is_exhausted = True
            return None

    def find_violation(self, sequence: FrameSequence) -> Violation | None:
        """What breaks the plan by the planner's order; None where nothing does, or no more plans may be tried."""
        try:
            return self._try_orders(sequence)
        except _PlanLimitError:
            self.is_exhausted = True
            return None

    def plan(self, sequence: FrameSequence) -> PlannedSequence | None:
        """The plan by the planner's order, late and trimmed as it may be; None out of reach, or when spent."""
        if first_unreachable(self._display, sequence) is not None:
            return None
        if self.plans_tried >= self.plans_max:
            self.is_exhausted = True
            return None
        self.plans_tried += 1
        try:
            return plan_sequence(
                self._display, sequence, self._heat, self._budget, "trim", lambda _share: self.on_progress()
            )
        except InputError:  # a train by height has no such cycle
            return None

    def prove_infeasible(self, sequence: FrameSequence, violation: Violation) -> tuple[bool, float | None]:
        """Whether no order can mend a breach, and the beam time that its frame takes at the least, s, if known."""
        if is_order_independent(violation, sequence):
            return True, None
        if violation.reason != "deadline":
            return False, None
        frame = sequence.frames[violation.source]
        lead_s = self._display.scan_head.settling.lead_in_us * 1e-6
        lower_bound_s = beam_lower_bound_s(self._display, sequence, self._heat, violation.source, lead_s)
        # The beam counts from a whole microsecond, a deadline does not.
        return (
            lower_bound_s is not None and lower_bound_s > frame.duration_s + MICROSECOND_S + TIME_TOLERANCE_S,
            lower_bound_s,
        )

    def _try_orders(self, sequence: FrameSequence, orders: Orders | None = None) -> Violation | None:
        """What breaks the plan by these orders first; the planner's own where None."""
        unreachable = first_unreachable(self._display, sequence) if orders is None else None
        if unreachable is not None:
            return Violation("unreachable", unreachable[0], unreachable[1])
        if self.plans_tried >= self.plans_max:
            raise _PlanLimitError
        self.plans_tried += 1
        try:
            # Most orders end early for want of time, and the limiter takes four times as long to ask.
            return self._plan_until_violation(sequence, orders, through_limiter=False) or self._plan_until_violation(
                sequence, orders, through_limiter=True
            )
        except InputError:  # as scaled or stretched, a train by height has no such cycle
            source, train = next((k, t) for k, t in enumerate(sequence.trains) if isinstance(t, HeightTrain))
            return Violation("unreachable", len(sequence.frames) + source, train.pixel)

    def _plan_until_violation(
        self, sequence: FrameSequence, orders: Orders | None, through_limiter: bool
    ) -> Violation | None:
        """Plan batch by batch up to the first violation, through the limiter or as if there were no caps."""
        scheduler = Scheduler(
            self._display.scan_head,
            sequence,
            self._display.build_cold_heat,
            on_progress=self.on_progress,
            visiting_orders=orders,
        )
        limiter = BatchLimiter(scheduler, self._display.budget, self._budget, len(sequence.frames))
        deadline_s = deadlines_s(sequence, scheduler.lead_in_us * 1e-6)

        def grant(batch: PulsePlan) -> PulsePlan | None:
            self.on_progress()
            return limiter.grant(batch) if through_limiter else batch

        violations = (find_first_violation(batch, deadline_s) for batch in scheduler.run(self._heat.copy(), grant))
        return next((violation for violation in violations if violation is not None), None)

    def _search_depth_first(self, sequence: FrameSequence) -> Orders | None:
        """Orders one after the other, depth first: all that begin as one did up to where it broke are passed over."""
        driven = [np.flatnonzero(frame.target_m > 0) for frame in sequence.frames]
        ranks = [list(range(len(pixels))) for pixels in driven]
        while True:
            orders = {source: pixels[ranks[source]] for source, pixels in enumerate(driven)}
            violation = self._try_orders(sequence, orders)
            if violation is None:
                return orders
            if is_order_independent(violation, sequence) or not _advance_orders(
                ranks, *_locate_violation(violation, orders, ranks)
            ):
                return None


def count_orders(sequence: FrameSequence) -> int:
    """In how many orders the pixels of all frames can be visited; beyond counting where pixels come several times."""
    if any(frame.simultaneous for frame in sequence.frames):
        return ORDERS_MAX + 1
    return prod(factorial(int(np.count_nonzero(frame.target_m > 0))) for frame in sequence.frames)


def _locate_violation(violation: Violation, orders: Orders, ranks: list[list[int]]) -> tuple[int, int]:
    """The frame and the place in its order up to which a breach is decided; for a train's pulse, the very last."""
    if violation.source < len(ranks):
        return violation.source, orders[violation.source].tolist().index(violation.pixel)
    return len(ranks) - 1, len(ranks[-1]) - 1 if ranks else 0


def _advance_orders(ranks: list[list[int]], source: int, place: int) -> bool:
    """To the next orders that differ up to this place of this frame, in place; False where there are no more."""
    for later in ranks[source + 1 :]:
        later.sort()
    while source >= 0:
        if _advance_permutation(ranks[source], place):
            return True
        ranks[source].sort()
        source -= 1
        place = len(ranks[source]) - 1
    return False


def _advance_permutation(rank: list[int], place: int) -> bool:
    """The next permutation that differs up to a place, in place; False where there is none."""
    rank[place + 1 :] = sorted(rank[place + 1 :], reverse=True)
    for k in range(len(rank) - 2, -1, -1):
        if rank[k] < rank[k + 1]:
            other = max(m for m in range(k + 1, len(rank)) if rank[m] > rank[k])
            rank[k], rank[other] = rank[other], rank[k]
            rank[k + 1 :] = rank[:k:-1]
            return True
    return False
