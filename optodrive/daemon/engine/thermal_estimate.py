"""What the daemon knows of heat: the planner's best estimate and the limiter's bound, on the board's time line."""

from dataclasses import dataclass

from optodrive.core.types.plans import BudgetState, ExecutedPulses
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.limiter.limiter import shift_state


@dataclass(frozen=True, eq=False)
class ThermalEstimate:
    """Heat and budget after everything planned so far; seconds of board time."""

    heat: ThermalState
    budget: BudgetState

    def shift_to_plan(self, start_s: float) -> tuple[ThermalState, BudgetState]:
        """Both on the time line of a plan that starts at start_s."""
        return self.heat.copy_shifted(-start_s), shift_state(self.budget, -start_s)

    @classmethod
    def from_plan(cls, heat: ThermalState, budget: BudgetState, start_s: float) -> "ThermalEstimate":
        """What a plan leaves, given on its own time line, on the board's."""
        return cls(heat.copy_shifted(start_s), shift_state(budget, start_s))

    def with_delay(self, delay_s: float) -> "ThermalEstimate":
        """Everything happened delay_s later than assumed."""
        return ThermalEstimate(self.heat.copy_shifted(delay_s), shift_state(self.budget, delay_s))


def apply_executed(before: ThermalState, executed: ExecutedPulses) -> ThermalState:
    """The heat of what was really executed, on the plan's time line as both arguments are."""
    heat = before.copy()
    heat.apply_pulses(executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    return heat
