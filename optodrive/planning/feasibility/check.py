"""Feasibility check of a sequence, the plan of a variant that fits, and the nearest lower or longer variants.

A feasible sequence costs one plan. Each variant is confirmed by a plan.
"""

from dataclasses import dataclass, replace
from math import ceil, sqrt

from optodrive.core.errors import OverBudgetError, RefusedError
from optodrive.core.types.plans import BudgetState
from optodrive.core.types.push_options import FitMode, Policy
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.order_search import ORDERS_MAX, Orders, OrderSearch, count_orders
from optodrive.planning.feasibility.reduction import omit_pixels, reduce_sequence, scale_sequence, stretch_sequence
from optodrive.planning.feasibility.report import FeasibilityReport, NearestFeasible, Proof
from optodrive.planning.feasibility.report_builder import (
    build_feasible_report,
    build_infeasible_report,
    build_reduction,
)
from optodrive.planning.feasibility.violation import Violation, deadlines_s, find_first_violation
from optodrive.planning.pipeline import Progress, plan_sequence
from optodrive.planning.planned_sequence import PlannedSequence, explain_nothing_raised
from optodrive.planning.sequence_checks import first_unreachable, remove_dead_pixels

TIME_FACTOR_MAX = 64.0
"""Largest time factor tried."""
TIME_FACTOR_STEP = 1.01
"""Ratio of the bracket's ends at which the search for the time factor stops."""


def find_height_factor(search: OrderSearch, sequence: FrameSequence) -> tuple[float, Orders] | None:
    """Find the largest factor on all heights and powers that fits, by bisection in hundredths.

    Returns the factor and the visiting orders, or None if no factor fits.
    """
    best: tuple[float, Orders] | None = None
    weakest_w = max(stage.min_power_w for stage in search.display.config.list_stage_configs())
    powers_w = [train.power_w for train in sequence.trains if isinstance(train, PulseTrain)]
    # A factor that makes a pulse weaker than its laser emits would leave the train dark.
    low, high = max((ceil(100.0 * weakest_w / power_w) for power_w in powers_w), default=1) - 1, 100
    while high - low > 1:
        middle = (low + high) // 2
        orders = search.find_orders(scale_sequence(sequence, middle / 100))
        if orders is None:
            high = middle
        else:
            low, best = middle, (middle / 100, orders)
    return best


def find_time_factor(search: OrderSearch, sequence: FrameSequence) -> tuple[float, Orders] | None:
    """Find the smallest factor on all times that fits, by doubling and bisection to within 1 %.

    Returns the factor and the visiting orders, or None if no factor up to TIME_FACTOR_MAX fits.
    """
    low, high = 1.0, 2.0
    orders = search.find_orders(stretch_sequence(sequence, high))
    while orders is None:
        low, high = high, 2.0 * high
        if high > TIME_FACTOR_MAX or search.is_exhausted:
            return None
        orders = search.find_orders(stretch_sequence(sequence, high))
    while high > TIME_FACTOR_STEP * low and not search.is_exhausted:
        middle = ceil(100 * sqrt(low * high)) / 100
        if middle >= high:
            break
        shorter_orders = search.find_orders(stretch_sequence(sequence, middle))
        if shorter_orders is None:
            low = middle
        else:
            high, orders = middle, shorter_orders
    return high, orders


PLANS_MAX = 1_000
"""Plans tried at most per kind of nearest feasible variant."""
PULSES_MAX = 30_000
"""Pulses planned at most per kind of variant: about one second of computation."""
PULSES_REQUESTED_MAX = 200_000
"""Pulses planned at most for the kind of variant that the caller requested: some seconds of computation."""
TERMS_PLAN_FRACTION = 0.05
"""Fraction of the plans tried when the model has planner terms, which make a pulse that much slower to plan."""
PLANS_MIN = 12
"""Plans tried at least for the kind of variant that the caller requested, regardless of the sequence's length."""


@dataclass(frozen=True, eq=False)
class _FeasibilityQuery:
    """A sequence with the display, thermal state, budget and fit mode of its check."""

    display: DisplayModel
    sequence: FrameSequence
    heat: ThermalState
    budget: BudgetState
    fit: FitMode
    on_progress: Progress

    def new_search(self, plans_max: int) -> OrderSearch:
        """Return a search that starts from the query's thermal state and budget."""
        return OrderSearch(self.display, self.heat, self.budget, lambda: self.on_progress(1.0), plans_max)

    def plan(
        self, policy: Policy = "trim", orders: Orders | None = None, replacement: FrameSequence | None = None
    ) -> PlannedSequence:
        """Plan the sequence or its replacement under a policy, in the planner's order or in the given orders."""
        sequence = self.sequence if replacement is None else replacement
        return plan_sequence(
            self.display, sequence, self.heat, self.budget, policy, self.on_progress, visiting_orders=orders
        )

    def plan_fraction(self) -> float:
        """Return the fraction of the plan limits that the model's computation time leaves."""
        return TERMS_PLAN_FRACTION if self.display.parameters.planner_terms else 1.0

    def compute_plans_max(self, is_requested: bool) -> int:
        """Compute the number of plans to try for one kind of variant.

        is_requested: the caller requested this kind
        """
        pulses = PULSES_REQUESTED_MAX if is_requested else PULSES_MAX
        frames = sum(int((frame.target_m > 0).sum()) for frame in self.sequence.frames)
        count = frames + sum(len(train.pulse_starts_s()) for train in self.sequence.trains)
        return max(min(PLANS_MAX, int(self.plan_fraction() * pulses / max(1, count))), PLANS_MIN if is_requested else 0)


def check_feasibility(
    display: DisplayModel,
    sequence: FrameSequence,
    heat: ThermalState,
    budget: BudgetState,
    on_progress: Progress | None = None,
    *,
    policy: Policy = "trim",
    fit: FitMode = "as_is",
) -> tuple[PlannedSequence, FeasibilityReport]:
    """Plan a sequence, or the part of it that fits, and report its feasibility.

    If the planner's order does not fit and the sequence has at most ORDERS_MAX orders, all orders are tried and the
    first that fits is planned. If none fits, `fit` decides: "as_is" applies the policy to the whole sequence, "even"
    scales all heights by one factor, "priority" omits the pixels and trains of lowest priority. Dead pixels are removed
    from the frames beforehand. A plan that raises no pixel does not fit.

    Returns the plan and the report. Raises as `plan_sequence` does, and RefusedError with the report if the policy is
    "refuse" or if no variant of the requested kind fits.
    """
    living, dead = remove_dead_pixels(display, sequence)
    query = _FeasibilityQuery(display, living, heat, budget, fit, on_progress or (lambda _share: None))
    planned, report = _check_query(query, policy)
    planned = replace(planned, dead_pixels=dead)
    nothing = explain_nothing_raised(planned)
    if nothing and report.fits:
        report = replace(report, fits=False, message=nothing, reason="nothing_raised")
        if policy == "refuse":
            raise _attach_report(RefusedError(nothing), report)
    elif nothing:
        report = replace(report, message=f"{nothing}; {report.message}")
    return planned, report


def _check_query(query: _FeasibilityQuery, policy: Policy) -> tuple[PlannedSequence, FeasibilityReport]:
    """Plan the query's sequence and report. Plan a variant if the plan violates a limit."""
    # "as_is" lets the planner refuse it by name; best effort may still draw the rest.
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
    """Plan a variant of a sequence whose plan violates a limit. The plan is None if a target is unreachable."""
    search = query.new_search(int(query.plan_fraction() * ORDERS_MAX))
    orders, proof, lower_bound_s = _search_other_orders(search, query.sequence, violation)
    if orders is not None:
        ordered = query.plan(orders=orders)
        ordered_report = build_feasible_report(ordered, proof, query.fit)
        return ordered, replace(ordered_report, plans_tried=search.plans_tried, plans_tried_max=search.plans_max)
    # A search of its own per kind: an exhausted one must not take plans from the kind that the caller requested.
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
        complete=not any(each.is_exhausted for each in searches),
    )
    report = replace(
        build_infeasible_report(query.sequence, plan, violation, proof, lower_bound_s, nearest),
        plans_tried=sum(each.plans_tried for each in (search, *searches)),
        plans_tried_max=sum(each.plans_max for each in (search, *searches)),
        fit=query.fit,
    )
    # Played late or trimmed, as the policy says: the report tells what would have fit.
    if query.fit == "as_is":
        return _apply_policy(query, plan, report, policy), report
    if query.fit == "even" and scaled is not None:
        return query.plan("trim", scaled[1], scale_sequence(query.sequence, scaled[0])), replace(
            report, height_factor=scaled[0]
        )
    if query.fit == "priority" and reduced is not None and nearest.pixels is not None:
        reduced_plan = query.plan("trim", reduced[1], omit_pixels(query.sequence, reduced[0]))
        return reduced_plan, replace(report, omitted=nearest.pixels.omitted)
    refusal = "no height fits" if query.fit == "even" else "no part of it fits"
    raise _attach_report(RefusedError(f"{refusal}: {report.message}"), report)


def _search_other_orders(
    search: OrderSearch, sequence: FrameSequence, violation: Violation
) -> tuple[Orders | None, Proof, float | None]:
    """Return orders that fit or None, the proof reached, and the lower bound of the frame's beam time in s if known."""
    impossible, lower_bound_s = search.prove_infeasible(sequence, violation)
    if impossible:
        return None, "bound", lower_bound_s
    if count_orders(sequence, search.stage_count) > ORDERS_MAX:
        return None, "not found", lower_bound_s
    orders = search.search_all_orders(sequence)
    return orders, "not found" if search.is_exhausted else "searched", lower_bound_s


def _apply_policy(
    query: _FeasibilityQuery, plan: PlannedSequence | None, report: FeasibilityReport, policy: Policy
) -> PlannedSequence:
    """Return the trimmed or delayed plan. Raise RefusedError under "refuse" and if no delay helps."""
    if plan is not None and policy == "trim":
        return plan
    try:
        if policy == "delay" or plan is None or plan.shortfall is not None:
            return query.plan(policy)
    except OverBudgetError as error:
        raise _attach_report(error, report) from None
    raise _attach_report(RefusedError(report.message), report)


def _attach_report(error: RefusedError, report: FeasibilityReport) -> RefusedError:
    """Return the error with the report attached."""
    error.feasibility = report.to_dict()
    return error
