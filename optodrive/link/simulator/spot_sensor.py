"""Simulated spot sensor: reports where the beam lands, by the lines of SENSOR.md."""

from collections import deque
from typing import NamedTuple

import numpy as np

from optodrive.core.quantity import m_to_um
from optodrive.device.config import Config, build_pixel_layout
from optodrive.link.simulator.galvos import SimulatedGalvos
from optodrive.link.simulator.true_geometry import GroundTruthGeometry

PULSE_MEMORY_US = 500_000
"""A pulse older than this no longer counts."""
SPOT_ENERGY_MIN_J = 10e-6
"""Minimum energy of a spot."""
FIELD_MARGIN_M = 6e-3
"""Margin of the field of view beyond the outermost pixels."""


class DetectedPulse(NamedTuple):
    """A pulse on the sensor that ended at at_us."""

    at_us: int
    x_m: float
    y_m: float
    energy_j: float


class SimulatedSpotSensor:
    """Detects pulses with noise at their ground-truth position, and a share of outliers anywhere in the field.

    blind: whether the sensor is covered; has_position_outputs: whether it reads the galvo driver's position outputs
    """

    def __init__(
        self,
        config: Config,
        geometry: GroundTruthGeometry,
        galvos: SimulatedGalvos,
        noise_m: float,
        outlier_share: float,
        has_position_outputs: bool,
        seed: int | np.random.SeedSequence,
    ) -> None:
        layout = build_pixel_layout(config.display)
        self._half_field_m = (
            float(np.abs(layout.x_m).max()) + FIELD_MARGIN_M,
            float(np.abs(layout.y_m).max()) + FIELD_MARGIN_M,
        )
        self._geometry, self._galvos = geometry, galvos
        self._noise_m, self._outlier_share, self._has_position_outputs = noise_m, outlier_share, has_position_outputs
        self._random = np.random.default_rng(seed)
        self._pulses: deque[DetectedPulse] = deque(maxlen=1000)
        self.blind = False

    def record_pulse(self, start_us: int, end_us: int, energy_j: float) -> None:
        """Record a pulse at the mirror angles of its mid-time."""
        x_m, y_m = self._geometry.position_m(*self._galvos.codes((start_us + end_us) // 2))
        if abs(float(x_m)) <= self._half_field_m[0] and abs(float(y_m)) <= self._half_field_m[1] and not self.blind:
            self._pulses.append(DetectedPulse(end_us, float(x_m), float(y_m), energy_j))

    def answer(self, request: str, now_us: int) -> str:
        """Return the line that answers a request line."""
        if request == "spot":
            return self._answer_spot(now_us)
        if request == "mirrors":
            if not self._has_position_outputs:
                return "mirrors none"
            x_rad, y_rad = self._galvos.position_output_rad(now_us)
            return f"mirrors {x_rad:.7f} {y_rad:.7f}"
        return "error unknown request"

    def _answer_spot(self, now_us: int) -> str:
        """Answer with the energy-weighted centroid of the pulses since the last answer, and clear them."""
        pulses = [pulse for pulse in self._pulses if pulse.at_us >= now_us - PULSE_MEMORY_US]
        self._pulses.clear()
        energy_j = sum(glimpse.energy_j for glimpse in pulses)
        if energy_j < SPOT_ENERGY_MIN_J:
            return "spot none"
        x_m = sum(glimpse.x_m * glimpse.energy_j for glimpse in pulses) / energy_j
        y_m = sum(glimpse.y_m * glimpse.energy_j for glimpse in pulses) / energy_j
        if self._random.random() < self._outlier_share:
            x_m, y_m = (self._random.uniform(-half_m, half_m) for half_m in self._half_field_m)
        x_um, y_um = m_to_um(np.array([x_m, y_m]) + self._noise_m * self._random.standard_normal(2))
        return f"spot {x_um:.2f} {y_um:.2f} {m_to_um(self._noise_m):.2f}"
