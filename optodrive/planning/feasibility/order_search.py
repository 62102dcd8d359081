"""Search for visiting orders that fit, from one thermal state and budget, with a limit on the number of plans.

The exhaustive search covers every order of every frame's pixels with each pulse at its earliest start; a train's pulse
precedes any pulse that would delay it. Deliberate waiting is not searched. It rarely helps, because a cooler pixel
needs a longer pulse; within the few milliseconds of the gas lag it can.
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
"""Orders up to which a sequence is searched exhaustively: three frames of four pixels have 13,824."""

MICROSECOND_S = 1e-6
"""Time step of the beam, s; a deadline is not rounded to it."""

Orders = Mapping[int, IntArray]
"""Visiting order of a frame's driven pixels, by source."""


class _PlanLimitError(Exception):
    """The search has tried its maximum number of plans."""


class OrderSearch:
    """Search for feasible plans with a limit on the number of plans.

    stage_count: number of optical stages; plans_tried: plans so far; is_exhausted: a plan beyond plans_max was needed;
    on_progress: progress callback.

    Results are visiting orders by source, from which `plan_sequence` makes the plan that was tried. An empty mapping
    stands for the planner's own order.
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
        self.stage_count = len(display.scan_heads)
        self.display = display
        self._heat = heat
        self._budget = budget
        self.on_progress = on_progress

    def find_orders(self, sequence: FrameSequence) -> Orders | None:
        """Return orders with which the sequence fits, the planner's own first, or None if none were found."""
        try:
            violation = self._try_orders(sequence)
            if violation is None:
                return {}
            is_small = count_orders(sequence, self.stage_count) <= ORDERS_MAX
            return (
                self._search_depth_first(sequence)
                if is_small and not self.prove_infeasible(sequence, violation)[0]
                else None
            )
        except _PlanLimitError:
            self.is_exhausted = True
            return None

    def search_all_orders(self, sequence: FrameSequence) -> Orders | None:
        """Return the first of all orders with which a small sequence fits.

        None proves that no order fits unless the search is exhausted.
        """
        try:
            return self._search_depth_first(sequence)
        except _PlanLimitError:
            self.is_exhausted = True
            return None

    def find_violation(self, sequence: FrameSequence) -> Violation | None:
        """Return the first violation of the plan in the planner's order.

        None means that the plan has no violation or that the search is exhausted.
        """
        try:
            return self._try_orders(sequence)
        except _PlanLimitError:
            self.is_exhausted = True
            return None

    def plan(self, sequence: FrameSequence) -> PlannedSequence | None:
        """Return the plan in the planner's order, late and trimmed where necessary.

        None means that a target is unreachable, that a height train has no such cycle, or that the search is exhausted.
        """
        if first_unreachable(self.display, sequence) is not None:
            return None
        if self.plans_tried >= self.plans_max:
            self.is_exhausted = True
            return None
        # Plans and not seconds are counted: the same question gets the same answer on every computer.
        self.plans_tried += 1
        try:
            return plan_sequence(
                self.display, sequence, self._heat, self._budget, "trim", lambda _share: self.on_progress()
            )
        except InputError:  # no steady cycle of a height train has this height and period
            return None

    def prove_infeasible(self, sequence: FrameSequence, violation: Violation) -> tuple[bool, float | None]:
        """Return whether no order removes a violation, and the lower bound of its frame's beam time in s if known."""
        # With several stages, a train that is late on one may not be on another.
        if violation.reason == "unreachable" or (self.stage_count == 1 and is_order_independent(violation, sequence)):
            return True, None
        if violation.reason != "deadline" or violation.source >= len(sequence.frames):
            return False, None
        frame = sequence.frames[violation.source]
        lead_in_s = max(head.settling.lead_in_us for head in self.display.scan_heads) * 1e-6
        lower_bound_s = beam_lower_bound_s(self.display, sequence, self._heat, violation.source, lead_in_s)
        # Pulses start on whole microseconds; a deadline need not lie on one.
        return (
            lower_bound_s is not None and lower_bound_s > frame.duration_s + MICROSECOND_S + TIME_TOLERANCE_S,
            lower_bound_s,
        )

    def _try_orders(self, sequence: FrameSequence, orders: Orders | None = None) -> Violation | None:
        """Return the first violation of the plan in the given orders, or in the planner's own if None."""
        unreachable = first_unreachable(self.display, sequence) if orders is None else None
        if unreachable is not None:
            return Violation("unreachable", unreachable[0], unreachable[1])
        if self.plans_tried >= self.plans_max:
            raise _PlanLimitError
        self.plans_tried += 1
        try:
            # Most orders miss a deadline early, and the limiter makes a plan four times as slow.
            return self._plan_until_violation(sequence, orders, through_limiter=False) or self._plan_until_violation(
                sequence, orders, through_limiter=True
            )
        except InputError:  # no steady cycle of a scaled or stretched height train has this height and period
            source, train = next((k, t) for k, t in enumerate(sequence.trains) if isinstance(t, HeightTrain))
            return Violation("unreachable", len(sequence.frames) + source, train.pixel)

    def _plan_until_violation(
        self, sequence: FrameSequence, orders: Orders | None, through_limiter: bool
    ) -> Violation | None:
        """Plan batch by batch up to the first violation, with or without the limiter."""
        scheduler = Scheduler(
            self.display.scan_heads,
            self.display.build_assignment(sequence),
            sequence,
            self.display.build_cold_heat,
            on_progress=self.on_progress,
            visiting_orders=orders,
        )
        limiter = BatchLimiter(scheduler, self.display.budget, self._budget, len(sequence.frames))
        deadline_s = deadlines_s(sequence, scheduler.lead_in_us * 1e-6)

        def grant(batch: PulsePlan) -> PulsePlan | None:
            self.on_progress()
            return limiter.grant(batch) if through_limiter else batch

        violations = (find_first_violation(batch, deadline_s) for batch in scheduler.run(self._heat.copy(), grant))
        return next((violation for violation in violations if violation is not None), None)

    def _search_depth_first(self, sequence: FrameSequence) -> Orders | None:
        """Try orders depth first, skipping all orders that share the prefix in which a violation occurred."""
        driven = [np.flatnonzero(frame.target_m > 0) for frame in sequence.frames]
        ranks = [list(range(len(pixels))) for pixels in driven]
        while True:
            orders = {source: pixels[ranks[source]] for source, pixels in enumerate(driven)}
            violation = self._try_orders(sequence, orders)
            if violation is None:
                return orders
            # The prefix up to the violation fails with any rest: all orders that share it are skipped at once.
            if is_order_independent(violation, sequence) or not _advance_orders(
                ranks, *_locate_violation(violation, orders, ranks)
            ):
                return None


def count_orders(sequence: FrameSequence, stage_count: int) -> int:
    """Return the number of visiting orders of all frames.

    ORDERS_MAX + 1 with simultaneous frames or several stages.
    """
    # Orders of several stages or rounds interact: no product of factorials counts them.
    if stage_count > 1 or any(frame.simultaneous for frame in sequence.frames):
        return ORDERS_MAX + 1
    return prod(factorial(int(np.count_nonzero(frame.target_m > 0))) for frame in sequence.frames)


def _locate_violation(violation: Violation, orders: Orders, ranks: list[list[int]]) -> tuple[int, int]:
    """Return the frame and the place in its order that decide a violation.

    The last place for a train's pulse.
    """
    if violation.source < len(ranks):
        return violation.source, orders[violation.source].tolist().index(violation.pixel)
    return len(ranks) - 1, len(ranks[-1]) - 1 if ranks else 0


def _advance_orders(ranks: list[list[int]], source: int, place: int) -> bool:
    """Advance in place to the next orders that differ up to this place of this frame, or return False."""
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
    """Advance in place to the next permutation that differs up to a place. Return False if there is none."""
    # The last permutation with this prefix: the step below then changes the prefix.
    rank[place + 1 :] = sorted(rank[place + 1 :], reverse=True)
    for k in range(len(rank) - 2, -1, -1):
        if rank[k] < rank[k + 1]:
            other = max(m for m in range(k + 1, len(rank)) if rank[m] > rank[k])
            rank[k], rank[other] = rank[other], rank[k]
            rank[k + 1 :] = rank[:k:-1]
            return True
    return False
