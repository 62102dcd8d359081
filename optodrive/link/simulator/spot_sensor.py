"""The simulated spot sensor, an instrument of its own that sees where the beam lands: lines as SENSOR.md says."""

from collections import deque
from typing import NamedTuple

import numpy as np

from optodrive.core.units import m_to_um
from optodrive.device.config import Config, build_pixel_layout
from optodrive.link.simulator.galvos import Mirrors
from optodrive.link.simulator.true_geometry import Truth

HOLD_US = 500_000
"""Light longer ago than this is forgotten."""
LEAST_J = 10e-6
"""Less light than this is no spot."""
MARGIN_M = 6e-3
"""The sensor sees so far beyond the outermost pixels."""


class Glimpse(NamedTuple):
    """Light that fell on the sensor until at_us."""

    at_us: int
    x_m: float
    y_m: float
    energy_j: float


class SpotSensor:
    """Sees pulses by the truth's geometry, with noise, and now and then something else: a reflection anywhere.

    blind: it is covered; outputs: whether the galvo driver's position outputs are wired to it.
    """

    def __init__(
        self,
        config: Config,
        truth: Truth,
        mirrors: Mirrors,
        noise_m: float,
        false_share: float,
        outputs: bool,
        seed: int | np.random.SeedSequence,
    ) -> None:
        layout = build_pixel_layout(config.display)
        self._half_m = float(np.abs(layout.x_m).max()) + MARGIN_M, float(np.abs(layout.y_m).max()) + MARGIN_M
        self._truth, self._mirrors = truth, mirrors
        self._noise_m, self._false_share, self._outputs = noise_m, false_share, outputs
        self._random = np.random.default_rng(seed)
        self._seen: deque[Glimpse] = deque(maxlen=1000)
        self.blind = False

    def saw(self, start_us: int, end_us: int, energy_j: float) -> None:
        """A pulse ended; it landed where the mirrors stood in its middle."""
        x_m, y_m = self._truth.position_m(*self._mirrors.codes((start_us + end_us) // 2))
        if abs(float(x_m)) <= self._half_m[0] and abs(float(y_m)) <= self._half_m[1] and not self.blind:
            self._seen.append(Glimpse(end_us, float(x_m), float(y_m), energy_j))

    def answer(self, request: str, now_us: int) -> str:
        """The line that answers a line."""
        if request == "spot":
            return self._spot(now_us)
        if request == "mirrors":
            if not self._outputs:
                return "mirrors none"
            x_rad, y_rad = self._mirrors.output_rad(now_us)
            return f"mirrors {x_rad:.7f} {y_rad:.7f}"
        return "error unknown request"

    def _spot(self, now_us: int) -> str:
        """The middle of all light since the last answer; what was told is forgotten."""
        seen = [glimpse for glimpse in self._seen if glimpse.at_us >= now_us - HOLD_US]
        self._seen.clear()
        energy_j = sum(glimpse.energy_j for glimpse in seen)
        if energy_j < LEAST_J:
            return "spot none"
        x_m = sum(glimpse.x_m * glimpse.energy_j for glimpse in seen) / energy_j
        y_m = sum(glimpse.y_m * glimpse.energy_j for glimpse in seen) / energy_j
        if self._random.random() < self._false_share:
            x_m, y_m = (self._random.uniform(-half_m, half_m) for half_m in self._half_m)
        x_um, y_um = m_to_um(np.array([x_m, y_m]) + self._noise_m * self._random.standard_normal(2))
        return f"spot {x_um:.2f} {y_um:.2f} {m_to_um(self._noise_m):.2f}"
