"""A configuration resolved into the models that planning uses."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.plans import BudgetState
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config, PixelLayout, build_pixel_layout
from optodrive.device.field_loader import build_settling_table, load_scan_field
from optodrive.device.pixel_map import build_aim_layout, load_pixel_map
from optodrive.device.sensitivity_map import load_sensitivity_map
from optodrive.physics.parameters import ParameterSet, PixelArray, build_display_pixels, load_parameters
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState, build_cold_state
from optodrive.planning.budget_setup import build_budget
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import build_cold_budget_state
from optodrive.planning.scheduler.scan_head import ScanHead
from optodrive.planning.scheduler.stage_assignment import PulseWidthEstimate, StageAssignment


@dataclass(frozen=True, eq=False)
class DisplayModel:
    """A display, its optical stages and its limits, as configured.

    layout: positions of the pixels; the layout of a scan head holds the positions to which its beam is sent for them
    scan_heads: of all stages; reach: [k, p] whether a stage's beam reaches a pixel
    dead: [p] whether a pixel is known to be dead
    """

    config: Config
    layout: PixelLayout
    parameters: ParameterSet
    pixels: PixelArray
    dead: BoolArray
    scan_heads: tuple[ScanHead, ...]
    reach: BoolArray
    budget: Budget

    @classmethod
    def from_config(cls, config: Config) -> "DisplayModel":
        """Load the files that a configuration names and build the models. Raise InputError for unusable values."""
        with config.name_file():
            return cls._build(config)

    @classmethod
    def _build(cls, config: Config) -> "DisplayModel":
        layout, pixel_map = build_pixel_layout(config.display), load_pixel_map(config)
        parameters = load_parameters(config.pixel_model.parameters)
        pixels = build_display_pixels(config, parameters)
        stages = config.list_stage_configs()
        scan_heads, reach = tuple(map(build_scan_head, stages)), np.stack([stage.reach for stage in stages])
        load_sensitivity_map(config)  # a damaged one is told at the start, not at the first request by intensity
        dead = np.zeros(len(layout), dtype=np.bool_) if pixel_map is None else pixel_map.dead
        if len(stages) > 1 and parameters.planner_terms:
            expected = "a parameter set without planner terms: they are planned with one stage"
            raise InputError("pixel_model.parameters", config.pixel_model.parameters, expected)
        budget = build_budget(config, parameters, pixels)
        return cls(config, layout, parameters, pixels, dead, scan_heads, reach, budget)

    def without_stage(self, lost: int | None) -> "DisplayModel":
        """Return the display without the beam of a stage that was lost, itself for None."""
        if lost is None:
            return self
        reach = self.reach.copy()
        reach[lost] = False
        return replace(self, reach=reach)

    @property
    def draws(self) -> BoolArray:
        """Whether each stage draws, [k]: not one that was lost."""
        return np.asarray(self.reach.any(axis=1))

    @property
    def scan_head(self) -> ScanHead:
        """The first stage's optics and mirrors."""
        return self.scan_heads[0]

    @property
    def ambient_k(self) -> float:
        """Ambient temperature, K."""
        return self.config.ambient_c + ZERO_CELSIUS_K

    def build_cold_heat(self) -> ThermalState:
        """Return the thermal state of a display at ambient temperature."""
        return build_cold_state(self.config, self.parameters, self.pixels)

    @cached_property
    def max_displacement_m(self) -> FloatArray:
        """Largest displacement that a single pulse of a stage reaches on a cold display, m, [p]."""
        cold = self.build_cold_heat()
        by_stage = [cold.max_displacement_m(scan_head.drive) for scan_head in self.scan_heads]
        # A pixel may get any stage that reaches it.
        # The smallest of the stages that reach it: which one it gets is decided later.
        reached = np.where(self.reach, np.stack(by_stage), np.inf)
        return np.asarray(reached.min(axis=0), dtype=np.float64)

    def build_cold_state(self) -> tuple[ThermalState, BudgetState]:
        """Return the thermal state and the budget state of a display at ambient temperature."""
        return self.build_cold_heat(), build_cold_budget_state(len(self.pixels), stage_count=len(self.scan_heads))

    @cached_property
    def pulse_widths(self) -> PulseWidthEstimate | None:
        """Estimated pulse widths by target, by which pixels are shared among stages. None with one stage."""
        if len(self.scan_heads) == 1:
            return None
        return PulseWidthEstimate.from_cold(self.build_cold_heat(), self.max_displacement_m, self.scan_head.drive)

    def build_assignment(self, sequence: FrameSequence) -> StageAssignment:
        """Return the assignment of pixels to stages for a plan of a sequence."""
        return StageAssignment(sequence, self.scan_heads, self.reach, self.pulse_widths)


def build_scan_head(config: Config) -> ScanHead:
    """Build optics and mirrors of the only stage of a configuration."""
    return ScanHead(
        layout=build_aim_layout(config),
        field=load_scan_field(config),
        settling=build_settling_table(config),
        drive=DriveRange.from_config(config),
        pulse_gap_s=config.limits.pulse_gap_min_s,
    )
