"""Simulation of executed pulses, after a plan has run."""

from optodrive.core.types.arrays import FloatArray
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.responses.plan import PlanStatus


def simulate_plan(plan: ActivePlan, status: PlanStatus, error: str | None) -> None:
    """Simulate the executed pulses of a plan and then end it, so that an ended plan always has its displacements."""
    try:
        plan.simulated_m = compute_simulated_m(plan)
        plan.update_execution()
    finally:
        if not plan.record.has_ended:
            plan.end(status, error)


def compute_simulated_m(plan: ActivePlan) -> FloatArray | None:
    """Compute the peak displacements of the executed pulses, [n]. Return None without a report of the board."""
    executed = plan.executed
    if executed is None:
        return None
    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    return plan.heat_before.copy().apply_pulses(*columns).displacement_m
