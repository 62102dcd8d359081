"""What the daemon knows of heat: the planner's best estimate and the limiter's bound, on the board's time line."""

from dataclasses import dataclass, replace

from optodrive.flow import BudgetState, ExecutedPulses
from optodrive.limit.limiter import shifted
from optodrive.physics.array import DisplayHeat


@dataclass(frozen=True, eq=False)
class Thermal:
    """Heat and budget after everything planned so far; seconds of board time."""

    heat: DisplayHeat
    budget: BudgetState

    def seen_from(self, start_s: float) -> tuple[DisplayHeat, BudgetState]:
        """Both on the time line of a plan that starts at start_s."""
        return self.heat.shifted(-start_s), shifted(self.budget, -start_s)

    @classmethod
    def after_plan(cls, heat: DisplayHeat, budget: BudgetState, start_s: float) -> "Thermal":
        """What a plan leaves, given on its own time line, on the board's."""
        return cls(heat.shifted(start_s), shifted(budget, start_s))

    def later(self, delay_s: float) -> "Thermal":
        """Everything happened delay_s later than assumed."""
        return Thermal(self.heat.shifted(delay_s), shifted(self.budget, delay_s))

    def with_heat_of(self, before: DisplayHeat, executed: ExecutedPulses, start_s: float) -> "Thermal":
        """The heat of what was really executed; the budget still counts everything that was sent."""
        heat = before.copy()
        rows = zip(executed.pixel, executed.start_s + start_s, executed.width_s, executed.power_w, strict=True)
        for pixel, at_s, width_s, power_w in rows:
            heat.pulse(int(pixel), float(at_s), float(width_s), float(power_w))
        return replace(self, heat=heat)
