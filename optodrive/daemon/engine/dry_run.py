"""State from which another process plans a dry run."""

import pickle
from typing import NamedTuple

from optodrive.core.types.plans import BudgetState
from optodrive.daemon.engine.engine import Engine
from optodrive.physics.thermal_state import ThermalState


class DryRunStart(NamedTuple):
    """State of the display at the start of a plan that is submitted now, on the plan's own time line.

    starts_in_s: time from now to that start; power_share: to which the display is dimmed
    lost_stage: the stage that was lost while the others go on, None without
    """

    heat: ThermalState
    budget: BudgetState
    starts_in_s: float
    power_share: float = 1.0
    lost_stage: int | None = None


def build_dry_run_start(engine: Engine) -> bytes:
    """Return the pickled start of a dry run."""
    snapshot = engine.plan_queue.make_snapshot(streamed=False, planning_time_s=0.0)
    starts_in_s, dimmer = snapshot.start_s - engine.board_s(), engine.dimmer
    start = DryRunStart(snapshot.heat, snapshot.budget, starts_in_s, dimmer.power_share, dimmer.lost_stage)
    return pickle.dumps(start, pickle.HIGHEST_PROTOCOL)
