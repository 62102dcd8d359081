"""Model prediction for a recording's drive, as one vector aligned with the measured one."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import DivergedError, Unquoted
from optodrive.core.types.arrays import FloatArray
from optodrive.device.servo import simulate_servo
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, PIXEL_KINDS, Dataset
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, simulate_signals
from optodrive.physics.stability import check_time_constants
from optodrive.physics.term import SignalDelays, TermValues
from optodrive.physics.terms import all_terms

BASE_PARAMETERS = ("R", "C", "tau_g", "kappa", "phi")
"""Fitted nominal parameters, all by their logarithms."""
BASE_UNITS = {"R": "K/W", "C": "J/K", "tau_g": "s", "kappa": "m/K", "phi": "N/K"}


@dataclass(frozen=True)
class ParameterPoint:
    """Parameters of a model: logarithms of the base parameters, and terms with their values."""

    base: tuple[float, ...]
    terms: Mapping[str, TermValues]

    def pixel(self, epsilon: float) -> Pixel:
        """Return the nominal pixel of the base parameters."""
        r, c, tau_g, kappa, phi = np.exp(np.array(self.base)).tolist()
        return Pixel(r, c, epsilon, tau_g, kappa, phi)


def predict(
    data: Dataset, point: ParameterPoint, epsilon: float = 0.66, power_factor: float = 1.0, delay_s: float = 0.0
) -> FloatArray:
    """Predict all samples [m]. power_factor scales all optical power, delay_s delays all signals.

    Raises DivergedError if a term is too fast for the integrator, a state leaves its range, or a sample is no number.
    """
    out = np.zeros(len(data.value))
    pixel = point.pixel(epsilon * power_factor)
    terms = [(all_terms()[key], values) for key, values in point.terms.items()]
    signal_delays = [term.signal_delays(values) for term, values in terms]
    signal_count = len(SignalDelays._fields)
    delays_s = [delay_s + sum(delays[signal] for delays in signal_delays) for signal in range(signal_count)]
    check_time_constants(point.terms)
    active = ActiveTerms.from_values(point.terms)
    if any(term.varies_between_runs for term, _ in terms):
        for experiment, numbers in data.experiments:
            signals = simulate_signals(experiment, pixel, active, (delays_s[0], delays_s[1], delays_s[2]))
            for kind in PIXEL_KINDS:
                if numbers[kind] >= 0:
                    out[data.blocks[numbers[kind]].part] = signals[kind]
    else:
        for item in data.drive_groups:
            signals = simulate_signals(item.experiment, pixel, active, (delays_s[0], delays_s[1], delays_s[2]))
            for kind, number, rows in item.block_rows:
                out[data.blocks[number].part] = signals[kind][rows]
    servo = next((servo for term, values in terms if (servo := term.servo(values)) is not None), None)
    for block in data.blocks:
        commands = data.runs[block.run].commands
        if block.kind in MIRROR_KINDS and commands is not None:
            column = commands[:, 1 + MIRROR_KINDS.index(block.kind)]
            out[block.part] = simulate_servo(commands[:, 0], column, block.t_s - delays_s[3], servo)
    if not np.isfinite(out).all():
        raise DivergedError(", ".join(point.terms) or "the nominal model", Unquoted("no number"), "finite predictions")
    return out
