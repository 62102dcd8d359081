"""Whether a sequence fits, said before anything moves; and what is planned in its place where something else is wanted.

A sequence that fits costs its plan and nothing more.
"""

from dataclasses import dataclass, replace

from optodrive.core.errors import OverBudgetError, RefusedError
from optodrive.core.types.plans import BudgetState
from optodrive.core.types.stimuli import FrameSequence
from optodrive.physics.thermal_state import Heat
from optodrive.planning.feasibility.nearest_feasible import lower, slower
from optodrive.planning.feasibility.order_search import ORDERS_MAX, Orders, Trials, orders_count
from optodrive.planning.feasibility.reduction import thinned
from optodrive.planning.feasibility.report import Admission, Fit, Nearest, Proof
from optodrive.planning.feasibility.report_builder import fitting, missing, thinned_set
from optodrive.planning.feasibility.sequence_edits import scaled, without
from optodrive.planning.feasibility.violation import Breach, deadlines_s, first_breach
from optodrive.planning.limiter.limiter import Policy
from optodrive.planning.pipeline import Display, Prepared, Progress, beyond_reach, prepare, without_dead

PLANS_MAX = 1_000
"""So many plans at most are tried for each of the nearest sets."""
PULSES_MAX = 30_000
PULSES_ASKED_MAX = 200_000
"""And so many pulses, a second's work; for what was asked for by name some seconds'."""
WITH_TERMS = 0.05
"""With terms in the model a pulse takes so much longer to plan; this share of plans then."""
PLANS_LEAST = 12
"""So many plans all the same for what was asked for by name, however long it is."""


@dataclass(frozen=True, eq=False)
class _Asked:
    """What was asked for, and what it is planned from. told: shows progress."""

    display: Display
    sequence: FrameSequence
    heat: Heat
    budget: BudgetState
    fit: Fit
    told: Progress

    def trials(self, plans_max: int) -> Trials:
        return Trials(self.display, self.heat, self.budget, lambda: self.told(1.0), plans_max)

    def planned(
        self, policy: Policy = "trim", orders: Orders | None = None, changed: FrameSequence | None = None
    ) -> Prepared:
        sequence = self.sequence if changed is None else changed
        return prepare(self.display, sequence, self.heat, self.budget, policy, self.told, orders=orders)

    def share(self) -> float:
        return WITH_TERMS if self.display.parameters.planner_terms else 1.0

    def plans_max(self, by_name: bool) -> int:
        """How many plans may be tried for one of the nearest sets, by_name: the one that was asked for."""
        pulses = PULSES_ASKED_MAX if by_name else PULSES_MAX
        frames = sum(int((frame.target_m > 0).sum()) for frame in self.sequence.frames)
        count = frames + sum(len(train.pulse_starts_s()) for train in self.sequence.trains)
        return max(min(PLANS_MAX, int(self.share() * pulses / max(1, count))), PLANS_LEAST if by_name else 0)


def admit(
    display: Display,
    sequence: FrameSequence,
    heat: Heat,
    budget: BudgetState,
    policy: Policy = "trim",
    progress: Progress | None = None,
    fit: Fit = "as_is",
) -> tuple[Prepared, Admission]:
    """Plan a sequence as `prepare` does, or what of it fits, and say whether all of it does.

    Where the planner's order does not fit and there are few, all orders are tried, and one that fits is the plan.
    "as_is": what does not fit goes by the policy; "even": lower by one factor; "priority": less of the less important.
    Dead pixels are left out of frames first. Raises as `prepare`; RefusedError, with the admission, under policy
    "refuse", and where nothing fits that is asked.
    """
    living, dead = without_dead(display, sequence)
    asked = _Asked(display, living, heat, budget, fit, progress or (lambda _share: None))
    prepared, admission = _admitted(asked, policy)
    return replace(prepared, dead=dead), admission


def _admitted(asked: _Asked, policy: Policy) -> tuple[Prepared, Admission]:
    beyond = None if asked.fit == "as_is" else beyond_reach(asked.display, asked.sequence)
    if beyond is not None:
        return _instead(asked, None, Breach("reach", beyond[0], beyond[1]), policy)
    plan = asked.planned()
    breach = first_breach(plan.plan, deadlines_s(asked.sequence, plan.lead_s))
    if breach is None:
        return plan, fitting(plan, "planned", asked.fit)
    return _instead(asked, plan, breach, policy)


def _instead(asked: _Asked, plan: Prepared | None, breach: Breach, policy: Policy) -> tuple[Prepared, Admission]:
    """What is planned of a sequence whose plan breaks; plan: None where a target is out of reach."""
    search = asked.trials(int(asked.share() * ORDERS_MAX))
    orders, proof, least_s = _settled(search, asked.sequence, breach)
    if orders is not None:
        ordered = asked.planned(orders=orders)
        found = fitting(ordered, proof, asked.fit)
        return ordered, replace(found, plans=search.plans, plans_max=search.plans_max)
    each = [asked.trials(asked.plans_max(asked.fit == fit)) for fit in ("priority", "even", None)]
    thin, low, slow = thinned(each[0], asked.sequence), lower(each[1], asked.sequence), slower(each[2], asked.sequence)
    nearest = Nearest(
        pixels=None if thin is None else thinned_set(asked.sequence, thin[0], breach.source),
        height=None if low is None else low[0],
        rate=None if slow is None else slow[0],
        complete=not any(trials.spent for trials in each),
    )
    admission = replace(
        missing(asked.sequence, plan, breach, proof, least_s, nearest),
        plans=sum(trials.plans for trials in (search, *each)),
        plans_max=sum(trials.plans_max for trials in (search, *each)),
        fit=asked.fit,
    )
    if asked.fit == "as_is":
        return _by_policy(asked, plan, admission, policy), admission
    if asked.fit == "even" and low is not None:
        return asked.planned("trim", low[1], scaled(asked.sequence, low[0])), replace(admission, height=low[0])
    if asked.fit == "priority" and thin is not None and nearest.pixels is not None:
        thinner = asked.planned("trim", thin[1], without(asked.sequence, thin[0]))
        return thinner, replace(admission, left_out=nearest.pixels.left_out)
    no = "no height fits" if asked.fit == "even" else "nothing of it fits"
    raise _with(RefusedError(f"{no}: {admission.sentence}"), admission)


def _settled(search: Trials, sequence: FrameSequence, breach: Breach) -> tuple[Orders | None, Proof, float | None]:
    """Other orders that fit, or how far it is proven that there are none, and the frame's least beam time, s."""
    impossible, least_s = search.proven(sequence, breach)
    if impossible:
        return None, "bound", least_s
    if orders_count(sequence) > ORDERS_MAX:
        return None, "not found", least_s
    orders = search.searched(sequence)
    return orders, "not found" if search.spent else "searched", least_s


def _by_policy(asked: _Asked, plan: Prepared | None, admission: Admission, policy: Policy) -> Prepared:
    """The plan as it is, or with its waits; raises under "refuse", and where waiting does not help."""
    if plan is not None and policy == "trim":
        return plan
    try:
        if policy == "delay" or plan is None or plan.shortfall is not None:
            return asked.planned(policy)
    except OverBudgetError as error:
        raise _with(error, admission) from None
    raise _with(RefusedError(admission.sentence), admission)


def _with(error: RefusedError, admission: Admission) -> RefusedError:
    error.admission = admission.answer()
    return error
