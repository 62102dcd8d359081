"""Ground truth of a simulated display: a parameter set with its terms, pixels that may deviate, and exact traces.

Calibrations have no access to it. Light beside the absorber is lost here; in a real display it heats the wall.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray, IntArray, ReadOnlyArrays
from optodrive.core.types.measurements import PixelTrace
from optodrive.core.types.plans import ExecutedPulses
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.pixel_map import load_pixel_map, remove_pixel_map
from optodrive.physics.parameters import PixelArray, build_display_pixels, list_own_terms, load_parameters
from optodrive.physics.terms import all_terms
from optodrive.physics.thermal_state import ThermalState, build_cold_state

GAIN_SIGMA, GAIN_RANGE = 0.15, (0.6, 1.5)
OFFSET_SIGMA_M, OFFSET_MAX_M = 60e-6, 150e-6
DEAD_SHARE = 0.04
DEAD_GAIN_MAX = 0.04
"""Maximum displacement gain of a dead pixel."""


@dataclass(frozen=True, eq=False)
class GroundTruthPixels(ReadOnlyArrays):
    """Pixel deviations from the model.

    displacement_gain: [p] relative to the model; x_m, y_m: [p] absorber centre from the pixel's centre; dead: indices
    """

    displacement_gain: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    dead: IntArray

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


def select_true_terms(config: Config, truth: Path | None) -> tuple[list[str], list[str]]:
    """Return the terms of the ground truth, and those of its parameter set that are left out.

    The truth has the planner terms and every term that its file states. Raises InputError for a term that the file
    states and that only the limiter accounts for.
    """
    parameters = load_parameters(config.pixel_model.parameters)
    own = () if truth is None or truth.suffix != ".toml" else list_own_terms(truth)
    for key in own:
        if not all_terms()[key].in_pixel:
            expected = "terms that pixels are simulated with; only the limiter accounts for this one"
            raise InputError(f"--truth {truth}: terms.{key}", key, expected)
    selected = list(dict.fromkeys((*parameters.planner_terms, *own)))
    return selected, [key for key in parameters.term_keys if key not in selected]


def build_true_display(config: Config, sampled_pixels: GroundTruthPixels | None, true_terms: list[str]) -> ThermalState:
    """Build the ground truth of the display: the configured model with sampled or equal pixels, without a pixel map."""
    parameters = load_parameters(config.pixel_model.parameters)
    parameters = parameters.model_copy(update={"planner_terms": tuple(true_terms)})
    nominal_pixels = build_display_pixels(remove_pixel_map(config), parameters)
    return build_cold_state(
        config, parameters, nominal_pixels if sampled_pixels is None else sampled_pixels.apply_to(nominal_pixels)
    )


TRACE_TAIL_S = 0.2
"""Duration of a trace after the last pulse."""
TRACE_LEAD_S = 0.02
"""Duration of a pixel's trace before its first pulse."""


def compute_traces(cold_state: ThermalState, executed: ExecutedPulses, pixels: list[int], dt_s: float) -> PixelTrace:
    """Compute the traces of pixels from the cold state, every dt_s until a fixed tail after the plan."""
    end_s = float(executed.start_s[-1] + executed.width_s[-1]) if len(executed) else 0.0
    t_s = np.arange(0.0, end_s + TRACE_TAIL_S, dt_s)
    pulses = np.column_stack([executed.start_s, executed.width_s, executed.power_w, executed.pixel])
    return cold_state.simulate_traces(pulses, pixels, t_s)


def compute_pixel_trace(
    cold_state: ThermalState, executed: ExecutedPulses, pixel: int, dt_s: float, after_s: float
) -> PixelTrace:
    """Compute one pixel's trace from the cold state, every dt_s until after_s after its last pulse."""
    is_pixel = executed.pixel == pixel
    if not is_pixel.any():
        return cold_state.simulate_traces(np.zeros((0, 4)), [pixel], np.arange(0.0, after_s, dt_s))
    first_s = max(0.0, float(executed.start_s[is_pixel][0]) - TRACE_LEAD_S)
    last_s = float((executed.start_s + executed.width_s)[is_pixel][-1]) + after_s
    pulses = np.column_stack([executed.start_s, executed.width_s, executed.power_w, executed.pixel])
    return cold_state.simulate_traces(pulses, [pixel], np.arange(first_s, last_s, dt_s))
