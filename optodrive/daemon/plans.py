"""A submitted plan through its life: queued, running, then done, failed or cancelled."""

from dataclasses import dataclass, field
from typing import Any, Literal

from optodrive.flow import ExecutedPulses, FloatArray
from optodrive.physics.array import DisplayHeat
from optodrive.pipeline import Prepared
from optodrive.summary import PULSES_LISTED_MAX, pulse_columns, summary
from optodrive.units import m_to_um

Status = Literal["planned", "queued", "running", "done", "failed", "cancelled"]


@dataclass
class PlanRecord:
    """One plan. start_s: board time of its zero; simulated_m: [n executed] displacement computed from what was executed."""

    plan_id: str
    name: str
    prepared: Prepared
    start_s: float
    heat_before: DisplayHeat
    status: Status = "queued"
    error: str | None = None
    sent: int = 0
    executed: ExecutedPulses | None = None
    simulated_m: FloatArray | None = None
    executed_count: int = 0
    delay_s: float = 0.0
    payloads: list[bytes] = field(default_factory=list)

    @property
    def ended(self) -> bool:
        """Whether nothing more will happen to it."""
        return self.status in ("planned", "done", "failed", "cancelled")

    def answer(self, board_now_s: float | None = None) -> dict[str, Any]:
        """The plan as REST answers it."""
        answer: dict[str, Any] = {
            "plan": self.plan_id,
            "name": self.name,
            "status": self.status,
            "error": self.error,
            "starts_in_s": None if board_now_s is None else self.start_s + self.delay_s - board_now_s,
            "planned": len(self.prepared.plan),
            "sent": self.sent,
            "executed": self.executed_count,
            "summary": summary(self.prepared),
            "pulses": pulse_columns(self.prepared),
            "executed_pulses": None,
        }
        if self.executed is not None:
            answer["executed_complete"] = self.executed.complete
            answer["delay_s"] = self.delay_s
            if self.simulated_m is not None and len(self.simulated_m):
                answer["simulated_max_um"] = m_to_um(float(self.simulated_m.max()))
            if len(self.executed) <= PULSES_LISTED_MAX:
                answer["executed_pulses"] = self._executed_columns()
        return answer

    def _executed_columns(self) -> dict[str, list[Any]]:
        executed = self.executed
        assert executed is not None  # noqa: S101 - the only caller has just looked
        return {
            "start_s": executed.start_s.tolist(),
            "width_s": executed.width_s.tolist(),
            "power_w": executed.power_w.tolist(),
            "pixel": executed.pixel.tolist(),
            "simulated_um": [] if self.simulated_m is None else m_to_um(self.simulated_m).tolist(),
        }
