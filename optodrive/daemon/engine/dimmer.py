"""Dimming: a cap on the power of plans, lower than the configured one, that outlives the planner process.

A stage that was lost is missing from the same display.
"""

from dataclasses import replace

from optodrive.core.errors import InputError
from optodrive.daemon.engine.thermal_memory import ThermalMemory
from optodrive.planning.display_model import DisplayModel


def dim_display(display: DisplayModel, share: float) -> DisplayModel:
    """Return a display whose pulses have at most a share of the laser's power, never more than configured."""
    caps = display.budget.caps
    if share >= caps.power_share:
        return display
    return replace(display, budget=display.budget._replace(caps=caps._replace(power_share=share)))


class Dimmer:
    """The display by which plans are made. Any thread may read `display`, which changes as a whole.

    lost_stage: the stage without which they are made, None for all stages
    memory: keeps the share for a later planner process, so that a restart brightens nothing
    """

    def __init__(self, display: DisplayModel, memory: ThermalMemory) -> None:
        self._full = display
        self._memory = memory
        self.lost_stage: int | None = None
        self.display = dim_display(display, memory.power_share)

    @property
    def power_share(self) -> float:
        """Largest power of a pulse as a share of the laser's."""
        return self.display.budget.caps.power_share

    def set_share(self, share: float) -> None:
        """Set the share for the plans from now on. Raise InputError above the configured one."""
        configured = self._full.budget.caps.power_share
        if not 0.0 <= share <= configured:
            raise InputError("share", share, f"a number from 0 to {configured:g}, limits.power_share as configured")
        self._memory.power_share = share
        self._build_display()

    def set_lost_stage(self, stage: int | None) -> None:
        """Make the plans from now on without a stage, None for all stages."""
        if stage != self.lost_stage:
            self.lost_stage = stage
            self._build_display()

    def _build_display(self) -> None:
        self.display = dim_display(self._full.without_stage(self.lost_stage), self._memory.power_share)
