"""Whether a sequence fits, said before anything moves; and what is planned in its place where something else is wanted.

A sequence that fits costs its plan and nothing more.
"""

from dataclasses import dataclass, replace

from optodrive.core.errors import OverBudgetError, RefusedError
from optodrive.core.types.plans import BudgetState
from optodrive.core.types.stimuli import FrameSequence
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.nearest_feasible import find_height_factor, find_time_factor
from optodrive.planning.feasibility.order_search import ORDERS_MAX, Orders, OrderSearch, count_orders
from optodrive.planning.feasibility.reduction import reduce_sequence
from optodrive.planning.feasibility.report import FeasibilityReport, FitMode, NearestFeasible, Proof
from optodrive.planning.feasibility.report_builder import (
    build_feasible_report,
    build_infeasible_report,
    build_reduction,
)
from optodrive.planning.feasibility.sequence_edits import omit_pixels, scale_sequence
from optodrive.planning.feasibility.violation import Violation, deadlines_s, find_first_violation
from optodrive.planning.limiter.limiter import Policy
from optodrive.planning.pipeline import Progress, plan_sequence
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.sequence_checks import first_unreachable, remove_dead_pixels

PLANS_MAX = 1_000
"""So many plans at most are tried for each of the nearest sets."""
PULSES_MAX = 30_000
PULSES_REQUESTED_MAX = 200_000
"""And so many pulses, a second's work; for what was asked for by name some seconds'."""
TERMS_PLAN_FRACTION = 0.05
"""With terms in the model a pulse takes so much longer to plan; this share of plans then."""
PLANS_MIN = 12
"""So many plans all the same for what was asked for by name, however long it is."""


@dataclass(frozen=True, eq=False)
class _FeasibilityQuery:
    """What was asked for, and what it is planned from. told: shows progress."""

    display: DisplayModel
    sequence: FrameSequence
    heat: ThermalState
    budget: BudgetState
    fit: FitMode
    on_progress: Progress

    def new_search(self, plans_max: int) -> OrderSearch:
        return OrderSearch(self.display, self.heat, self.budget, lambda: self.on_progress(1.0), plans_max)

    def plan(
        self, policy: Policy = "trim", orders: Orders | None = None, replacement: FrameSequence | None = None
    ) -> PlannedSequence:
        sequence = self.sequence if replacement is None else replacement
        return plan_sequence(
            self.display, sequence, self.heat, self.budget, policy, self.on_progress, visiting_orders=orders
        )

    def plan_fraction(self) -> float:
        return TERMS_PLAN_FRACTION if self.display.parameters.planner_terms else 1.0

    def compute_plans_max(self, is_requested: bool) -> int:
        """How many plans may be tried for one of the nearest sets, by_name: the one that was asked for."""
        pulses = PULSES_REQUESTED_MAX if is_requested else PULSES_MAX
        frames = sum(int((frame.target_m > 0).sum()) for frame in self.sequence.frames)
        count = frames + sum(len(train.pulse_starts_s()) for train in self.sequence.trains)
        return max(min(PLANS_MAX, int(self.plan_fraction() * pulses / max(1, count))), PLANS_MIN if is_requested else 0)


def check_feasibility(
    display: DisplayModel,
    sequence: FrameSequence,
    heat: ThermalState,
    budget: BudgetState,
    policy: Policy = "trim",
    on_progress: Progress | None = None,
    fit: FitMode = "as_is",
) -> tuple[PlannedSequence, FeasibilityReport]:
    """Plan a sequence as `prepare` does, or what of it fits, and say whether all of it does.

    Where the planner's order does not fit and there are few, all orders are tried, and one that fits is the plan.
    "as_is": what does not fit goes by the policy; "even": lower by one factor; "priority": less of the less important.
    Dead pixels are left out of frames first. Raises as `prepare`; RefusedError, with the admission, under policy
    "refuse", and where nothing fits that is asked.
    """
    living, dead = remove_dead_pixels(display, sequence)
    query = _FeasibilityQuery(display, living, heat, budget, fit, on_progress or (lambda _share: None))
    prepared, report = _check_query(query, policy)
    return replace(prepared, dead_pixels=dead), report


def _check_query(query: _FeasibilityQuery, policy: Policy) -> tuple[PlannedSequence, FeasibilityReport]:
    unreachable = None if query.fit == "as_is" else first_unreachable(query.display, query.sequence)
    if unreachable is not None:
        return _plan_alternative(query, None, Violation("unreachable", unreachable[0], unreachable[1]), policy)
    plan = query.plan()
    violation = find_first_violation(plan.plan, deadlines_s(query.sequence, plan.lead_in_s))
    if violation is None:
        return plan, build_feasible_report(plan, "planned", query.fit)
    return _plan_alternative(query, plan, violation, policy)


def _plan_alternative(
    query: _FeasibilityQuery, plan: PlannedSequence | None, violation: Violation, policy: Policy
) -> tuple[PlannedSequence, FeasibilityReport]:
    """What is planned of a sequence whose plan breaks; plan: None where a target is out of reach."""
    search = query.new_search(int(query.plan_fraction() * ORDERS_MAX))
    orders, proof, lower_bound_s = _search_other_orders(search, query.sequence, violation)
    if orders is not None:
        ordered = query.plan(orders=orders)
        report_found = build_feasible_report(ordered, proof, query.fit)
        return ordered, replace(report_found, plans_tried=search.plans_tried, plans_tried_max=search.plans_max)
    searches = [query.new_search(query.compute_plans_max(query.fit == fit)) for fit in ("priority", "even", None)]
    reduced, scaled, stretched = (
        reduce_sequence(searches[0], query.sequence),
        find_height_factor(searches[1], query.sequence),
        find_time_factor(searches[2], query.sequence),
    )
    nearest = NearestFeasible(
        pixels=None if reduced is None else build_reduction(query.sequence, reduced[0], violation.source),
        height_factor=None if scaled is None else scaled[0],
        time_factor=None if stretched is None else stretched[0],
        complete=not any(trials.is_exhausted for trials in searches),
    )
    report = replace(
        build_infeasible_report(query.sequence, plan, violation, proof, lower_bound_s, nearest),
        plans_tried=sum(trials.plans_tried for trials in (search, *searches)),
        plans_tried_max=sum(trials.plans_max for trials in (search, *searches)),
        fit=query.fit,
    )
    if query.fit == "as_is":
        return _apply_policy(query, plan, report, policy), report
    if query.fit == "even" and scaled is not None:
        return query.plan("trim", scaled[1], scale_sequence(query.sequence, scaled[0])), replace(
            report, height_factor=scaled[0]
        )
    if query.fit == "priority" and reduced is not None and nearest.pixels is not None:
        reduced_plan = query.plan("trim", reduced[1], omit_pixels(query.sequence, reduced[0]))
        return reduced_plan, replace(report, omitted=nearest.pixels.omitted)
    refusal = "no height fits" if query.fit == "even" else "nothing of it fits"
    raise _attach_report(RefusedError(f"{refusal}: {report.message}"), report)


def _search_other_orders(
    search: OrderSearch, sequence: FrameSequence, violation: Violation
) -> tuple[Orders | None, Proof, float | None]:
    """Other orders that fit, or how far it is proven that there are none, and the frame's least beam time, s."""
    impossible, lower_bound_s = search.prove_infeasible(sequence, violation)
    if impossible:
        return None, "bound", lower_bound_s
    if count_orders(sequence) > ORDERS_MAX:
        return None, "not found", lower_bound_s
    orders = search.search_all_orders(sequence)
    return orders, "not found" if search.is_exhausted else "searched", lower_bound_s


def _apply_policy(
    query: _FeasibilityQuery, plan: PlannedSequence | None, report: FeasibilityReport, policy: Policy
) -> PlannedSequence:
    """The plan as it is, or with its waits; raises under "refuse", and where waiting does not help."""
    if plan is not None and policy == "trim":
        return plan
    try:
        if policy == "delay" or plan is None or plan.shortfall is not None:
            return query.plan(policy)
    except OverBudgetError as error:
        raise _attach_report(error, report) from None
    raise _attach_report(RefusedError(report.message), report)


def _attach_report(error: RefusedError, report: FeasibilityReport) -> RefusedError:
    error.feasibility = report.to_dict()
    return error
