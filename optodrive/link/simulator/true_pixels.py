"""What each pixel of a simulated display really is: how high it stands, where its absorber lies, and whether it lives.

No calibration sees this. Light that misses the absorber is lost here; in a real display it warms the wall.
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
"""What is left of a dead pixel's displacement, at the most."""


@dataclass(frozen=True, eq=False)
class GroundTruthPixels:
    """All [p]. lift: displacement over the model's; x_m, y_m: the absorber's middle from the pixel's; dead: indices."""

    displacement_gain: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    dead: IntArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @classmethod
    def sample(cls, seed: int, config: Config) -> Self:
        """Pixels within a workshop's tolerances, one of 25 dead and one at least; the same for the same seed."""
        random, count = np.random.default_rng([seed, 0x9135]), len(build_pixel_layout(config.display))
        displacement_gain = np.clip(np.exp(GAIN_SIGMA * random.standard_normal(count)), *GAIN_RANGE)
        x_m, y_m = np.clip(OFFSET_SIGMA_M * random.standard_normal((2, count)), -OFFSET_MAX_M, OFFSET_MAX_M)
        dead_count = min(count - 1, max(1, round(DEAD_SHARE * count)))
        dead = np.sort(random.choice(count, dead_count, replace=False))
        displacement_gain[dead] = random.uniform(0.0, DEAD_GAIN_MAX, dead_count)
        return cls(displacement_gain, x_m, y_m, dead)

    def apply_to(self, nominal: PixelArray) -> PixelArray:
        """The display's pixels as they are."""
        return replace(nominal, kappa_m_per_k=nominal.kappa_m_per_k * self.displacement_gain)

    def attenuate(self, executed: ExecutedPulses, config: Config) -> ExecutedPulses:
        """What was executed, with the mean power that falls on each pixel's absorber."""
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
