"""A configuration resolved into the models that planning uses."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.plans import BudgetState
from optodrive.core.units import ZERO_CELSIUS_K
from optodrive.device.config import Config, PixelLayout, build_pixel_layout
from optodrive.device.field_loader import build_settling_table, load_scan_field
from optodrive.device.pixel_map import build_aim_layout, load_pixel_map
from optodrive.physics.parameters import ParameterSet, PixelArray, build_display_pixels, load_parameters
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState, build_cold_state
from optodrive.planning.budget_setup import build_budget
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import build_cold_budget_state
from optodrive.planning.scheduler.scan_head import ScanHead


@dataclass(frozen=True, eq=False)
class DisplayModel:
    """A display, its scan head and its limits, as configured.

    layout: positions of the pixels; scan_head.layout holds the positions to which the beam is sent for them
    dead: [p] whether a pixel is known to be dead
    """

    config: Config
    layout: PixelLayout
    parameters: ParameterSet
    pixels: PixelArray
    dead: BoolArray
    scan_head: ScanHead
    budget: Budget

    @classmethod
    def from_config(cls, config: Config) -> "DisplayModel":
        """Load the files that a configuration names and build the models; raises InputError for unusable values."""
        layout, pixel_map = build_pixel_layout(config.display), load_pixel_map(config)
        parameters = load_parameters(config.pixel_model.parameters)
        pixels = build_display_pixels(config, parameters)
        limits, laser = config.limits, config.laser
        scan_head = ScanHead(
            layout=build_aim_layout(config),
            field=load_scan_field(config),
            settling=build_settling_table(config),
            drive=DriveRange.from_laser(laser.max_power_w, laser.pwm_hz, limits.pulse_width_max_s),
            pulse_gap_s=limits.pulse_gap_min_s,
        )
        dead = np.zeros(len(layout), dtype=np.bool_) if pixel_map is None else pixel_map.dead
        return cls(config, layout, parameters, pixels, dead, scan_head, build_budget(config, parameters, pixels))

    @property
    def ambient_k(self) -> float:
        """Ambient temperature, K."""
        return self.config.ambient_c + ZERO_CELSIUS_K

    def build_cold_heat(self) -> ThermalState:
        """Return the thermal state of a display at ambient temperature."""
        return build_cold_state(self.config, self.parameters, self.pixels)

    @cached_property
    def max_displacement_m(self) -> FloatArray:
        """Largest displacement that a single pulse reaches on a cold display, m, [p]."""
        return self.build_cold_heat().max_displacement_m(self.scan_head.drive)

    def build_cold_state(self) -> tuple[ThermalState, BudgetState]:
        """Return the thermal state and the budget state of a display at ambient temperature."""
        return self.build_cold_heat(), build_cold_budget_state(len(self.pixels))
