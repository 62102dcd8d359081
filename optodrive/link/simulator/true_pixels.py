"""Ground truth of the pixels of a simulated display: displacement gain, absorber position, and dead pixels.

Calibrations have no access to it. Light beside the absorber is lost here; in a real display it heats the wall.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray, freeze_arrays
from optodrive.core.types.plans import ExecutedPulses
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.pixel_map import load_pixel_map
from optodrive.physics.parameters import PixelArray

GAIN_SIGMA, GAIN_RANGE = 0.15, (0.6, 1.5)
OFFSET_SIGMA_M, OFFSET_MAX_M = 60e-6, 150e-6
DEAD_SHARE = 0.04
DEAD_GAIN_MAX = 0.04
"""Maximum displacement gain of a dead pixel."""


@dataclass(frozen=True, eq=False)
class GroundTruthPixels:
    """Pixel deviations from the model.

    displacement_gain: [p] relative to the model; x_m, y_m: [p] absorber centre from the pixel's centre; dead: indices
    """

    displacement_gain: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    dead: IntArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @classmethod
    def sample(cls, seed: int, config: Config) -> Self:
        """Sample pixels within manufacturing tolerances, 4 % dead but at least one, reproducible by seed."""
        random, count = np.random.default_rng([seed, 0x9135]), len(build_pixel_layout(config.display))
        displacement_gain = np.clip(np.exp(GAIN_SIGMA * random.standard_normal(count)), *GAIN_RANGE)
        x_m, y_m = np.clip(OFFSET_SIGMA_M * random.standard_normal((2, count)), -OFFSET_MAX_M, OFFSET_MAX_M)
        dead_count = min(count - 1, max(1, round(DEAD_SHARE * count)))
        dead = np.sort(random.choice(count, dead_count, replace=False))
        displacement_gain[dead] = random.uniform(0.0, DEAD_GAIN_MAX, dead_count)
        return cls(displacement_gain, x_m, y_m, dead)

    def apply_to(self, nominal: PixelArray) -> PixelArray:
        """Return the nominal pixels with the ground-truth displacement gains."""
        return replace(nominal, kappa_m_per_k=nominal.kappa_m_per_k * self.displacement_gain)

    def attenuate(self, executed: ExecutedPulses, config: Config) -> ExecutedPulses:
        """Return the executed pulses with the mean power on each pixel's absorber."""
        display, laser, pixel_map = config.display, config.laser, load_pixel_map(config)
        share = np.ones(len(self.displacement_gain))
        for axis, side in (("x", "width"), ("y", "height")):
            center_m = -getattr(self, f"{axis}_m")
            if pixel_map is not None:
                center_m = center_m + getattr(pixel_map, f"offset_{axis}_m")
            focus_m, absorber_m = getattr(laser, f"focus_{side}_m"), getattr(display, f"absorber_{side}_m")
            low_m = np.maximum(center_m - 0.5 * focus_m, -0.5 * absorber_m)
            high_m = np.minimum(center_m + 0.5 * focus_m, 0.5 * absorber_m)
            share *= np.maximum(0.0, high_m - low_m) / focus_m
        return replace(executed, power_w=executed.power_w * share[executed.pixel])
