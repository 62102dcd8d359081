"""Simulation of executed pulses, after a plan has run."""

from optodrive.core.types.arrays import FloatArray
from optodrive.daemon.one_process.plan_record import PlanRecord
from optodrive.daemon.responses.plan import PlanStatus


def simulate_record(record: PlanRecord, status: PlanStatus, error: str | None) -> None:
    """Simulate the executed pulses of a plan and then end it, so that an ended plan always has its displacements."""
    try:
        record.simulated_m = compute_simulated_m(record)
    finally:
        if not record.has_ended:
            record.end(status, error)


def compute_simulated_m(record: PlanRecord) -> FloatArray | None:
    """Compute the peak displacements of the executed pulses, [n]; None without a report of the board."""
    executed = record.executed
    if executed is None:
        return None
    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    return record.heat_before.copy().apply_pulses(*columns).displacement_m
