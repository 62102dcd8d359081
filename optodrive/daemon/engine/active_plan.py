"""A plan that waits or runs, with its record, thermal states and points."""

from collections.abc import Callable
from dataclasses import dataclass, field

from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, ExecutedPulses
from optodrive.daemon.engine.plan_record import Execution, PlanRecord
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.planned_sequence import PlannedSequence


@dataclass(eq=False)
class ActivePlan:
    """A plan with its thermal states and points, a megabyte for a frame of 1,500 pixels. Only its record outlives it.

    heat_before, budget_before: initial state of the plan, on its own time line
    epoch: in which the request arrived; the board executes nothing of an older one
    crc: CRC-32 of the verified bytes of the points
    refreshed: [p] pixels that the stream's refresh cycle had drawn before this plan
    executed, executed_rows, simulated_m: what the board reports, [n executed] plan rows, and displacements computed
    from it
    on_end: called with the plan at its end; must neither block nor raise
    """

    record: PlanRecord
    planned: PlannedSequence
    points: WirePoints
    heat_before: ThermalState
    budget_before: BudgetState
    epoch: int
    crc: int
    refreshed: BoolArray | None = None
    executed: ExecutedPulses | None = None
    executed_rows: IntArray | None = None
    simulated_m: FloatArray | None = None
    on_end: "Callable[[ActivePlan], None]" = field(default=lambda plan: None)

    def update_execution(self) -> None:
        """Write to the record what was executed and simulated so far."""
        if self.executed is not None and self.executed_rows is not None:
            self.record.execution = Execution.from_pulses(
                self.executed, self.executed_rows, self.simulated_m, self.record.largest_target
            )

    def end(self, status: PlanStatus, error: str | None) -> None:
        """End the plan with a final status."""
        self.record.status, self.record.error = status, error
        self.on_end(self)
