"""Timing error of executed pulses against their plan."""

from dataclasses import asdict, dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray


@dataclass(frozen=True)
class TimingError:
    """Executed start − planned start of a plan's pulses, both from the plan's zero on the board's clock, s.

    start_delay_s: error of the first pulse, which shifts the whole plan
    median_s: median error
    max_abs_s: signed error of largest magnitude
    drift_ppm: slope over planned time of the error without the start delay, 0 if all pulses start at one time
    pulses: number of executed pulses that were compared
    """

    pulses: int
    start_delay_s: float
    median_s: float
    max_abs_s: float
    drift_ppm: float


def compute_timing_error(planned_s: FloatArray, executed_s: FloatArray) -> TimingError | None:
    """Compute the error from planned and executed starts of the same pulses, [n] each. Return None without pulses."""
    if not len(planned_s):
        return None
    error_s = executed_s - planned_s
    residual_s, centred_s = error_s - error_s[0], planned_s - planned_s.mean()
    spread_s2 = float(centred_s @ centred_s)
    return TimingError(
        pulses=len(error_s),
        start_delay_s=float(error_s[0]),
        median_s=float(np.median(error_s)),
        max_abs_s=float(error_s[np.abs(error_s).argmax()]),
        drift_ppm=1e6 * float(centred_s @ residual_s) / spread_s2 if spread_s2 else 0.0,
    )


class TimingTotals:
    """Totals over all plans.

    worst: number of pulses, and the error of largest magnitude of every kind; None before the first pulse
    """

    def __init__(self) -> None:
        self.worst: TimingError | None = None

    def add(self, error: TimingError) -> None:
        """Add the error of a plan."""
        previous = self.worst
        if previous is None:
            self.worst = error
            return
        worst = {
            name: max(value, getattr(previous, name), key=abs)
            for name, value in asdict(error).items()
            if name != "pulses"
        }
        self.worst = TimingError(pulses=previous.pulses + error.pulses, **worst)
