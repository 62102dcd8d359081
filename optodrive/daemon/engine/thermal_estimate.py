"""What the daemon knows of heat: the planner's best estimate and the limiter's bound, on the board's time line."""

from dataclasses import dataclass

from optodrive.core.types.plans import BudgetState, ExecutedPulses
from optodrive.physics.thermal_state import Heat
from optodrive.planning.limiter.limiter import shifted


@dataclass(frozen=True, eq=False)
class Thermal:
    """Heat and budget after everything planned so far; seconds of board time."""

    heat: Heat
    budget: BudgetState

    def seen_from(self, start_s: float) -> tuple[Heat, BudgetState]:
        """Both on the time line of a plan that starts at start_s."""
        return self.heat.shifted(-start_s), shifted(self.budget, -start_s)

    @classmethod
    def after_plan(cls, heat: Heat, budget: BudgetState, start_s: float) -> "Thermal":
        """What a plan leaves, given on its own time line, on the board's."""
        return cls(heat.shifted(start_s), shifted(budget, start_s))

    def later(self, delay_s: float) -> "Thermal":
        """Everything happened delay_s later than assumed."""
        return Thermal(self.heat.shifted(delay_s), shifted(self.budget, delay_s))


def heated(before: Heat, executed: ExecutedPulses) -> Heat:
    """The heat of what was really executed, on the plan's time line as both arguments are."""
    heat = before.copy()
    heat.pulses(executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    return heat
