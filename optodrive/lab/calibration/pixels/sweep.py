"""Pulses that determine every pixel's gain and offset, one per pixel at each of a few aims.

Across an edge, part of the focus misses the absorber and falls on the wall, which the limiter does not model. Those
pulses are weak enough to keep even black acrylic below the wall's cap.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray
from optodrive.core.types.stimuli import PulseTrain
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.pixel_map import PixelMap
from optodrive.device.scan_field import ScanField
from optodrive.lab.calibration.pixels.fit import Optics

EDGE_FRACTIONS = (0.7, 0.3)
"""Nominal fractions of the focus on the absorber for aims across an edge."""
ENERGY_FRACTION = 0.1
"""Fraction of the largest allowed pulse energy, for pulses on the middle."""
WALL_HEADROOM_FRACTION = 0.8
"""Fraction of the headroom below limits.wall_max_c, for pulses that partly miss the absorber."""
ACRYLIC_EFFUSIVITY_W_S05_PER_M2_K = (0.19 * 1.75e6) ** 0.5
"""Thermal effusivity of acrylic: 0.19 W/(m K), and 1.75 MJ/(m³ K), Table S4."""
GATE_OFF_S = 0.05
"""Time from a pulse's end to the next pulse on any pixel, s; gas and absorber are cold after a few of them."""


class Aim(NamedTuple):
    """Position of the beam from each pixel's middle, m.

    name: of its files
    """

    name: str
    x_m: float
    y_m: float


def list_aims(config: Config) -> list[Aim]:
    """Return the middle, and two aims across each edge."""
    optics = Optics.from_config(config)
    edge_offsets_m = [
        [
            optics.absorber_half_m[axis] + (1.0 - 2.0 * fraction) * optics.focus_half_m[axis]
            for fraction in EDGE_FRACTIONS
        ]
        for axis in range(2)
    ]
    aims = [Aim("middle", 0.0, 0.0)]
    for sign, suffix in ((-1.0, "minus"), (1.0, "plus")):
        aims += [
            Aim(f"x-{suffix}-{k}", round(sign * offset_m, 9), 0.0) for k, offset_m in enumerate(edge_offsets_m[0], 1)
        ]
        aims += [
            Aim(f"y-{suffix}-{k}", 0.0, round(sign * offset_m, 9)) for k, offset_m in enumerate(edge_offsets_m[1], 1)
        ]
    return aims


def compute_pitch_min_m(config: Config, aims: list[Aim]) -> float:
    """Return the smallest pitch at which the focus stays in the pixel's cell at every aim, m."""
    widths_m = [
        2.0 * abs(offset_m) + focus_m
        for aim in aims
        for offset_m, focus_m in ((aim.x_m, config.laser.focus_width_m), (aim.y_m, config.laser.focus_height_m))
    ]
    return max(widths_m)


def compute_pulse(config: Config, aim: Aim) -> tuple[float, float]:
    """Return width, s, and power, W, of an aim's pulses: short ones on the middle, weak ones across an edge."""
    laser, limits = config.laser, config.limits
    if aim.x_m == aim.y_m == 0.0:
        energy_j = ENERGY_FRACTION * limits.pulse_energy_max_j
        periods = max(1, int(energy_j / laser.max_power_w * laser.pwm_hz))
        width_s = min(periods / laser.pwm_hz, limits.pulse_width_max_s)
        return width_s, min(laser.max_power_w, energy_j / width_s)
    width_s = int(limits.pulse_width_max_s * laser.pwm_hz + 1e-6) / laser.pwm_hz
    return width_s, edge_power_max_w(config, width_s)


def edge_power_max_w(config: Config, width_s: float) -> float:
    """Return the power at which a wall that absorbs all the light stays below its cap, W.

    The surface of a half-space rises with √t over its effusivity. The rises by the mean power and by the ripple of the
    PWM are added; each grows with the square root of its duration.
    """
    laser, limits = config.laser, config.limits
    headroom_k = WALL_HEADROOM_FRACTION * (limits.wall_max_c - config.ambient_c)
    rise_k_per_w_s05 = 2.0 / (
        ACRYLIC_EFFUSIVITY_W_S05_PER_M2_K * np.pi**0.5 * laser.focus_width_m * laser.focus_height_m
    )
    mean = rise_k_per_w_s05 * width_s**0.5
    ripple = rise_k_per_w_s05 * (laser.max_power_w / laser.pwm_hz) ** 0.5
    root = (-ripple + np.sqrt(ripple**2 + 4.0 * mean * headroom_k)) / (2.0 * mean)
    energy_w = ENERGY_FRACTION * limits.pulse_energy_max_j / width_s
    return float(min(root**2, energy_w, laser.max_power_w))


def is_reachable(config: Config, field: ScanField, aim: Aim) -> BoolArray:
    """Return for which pixels an aim is within the range of the mirrors, [p]."""
    layout, range_rad = build_pixel_layout(config.display), config.scanner.range_rad
    angles_rad = field.angles_rad(layout.x_m + aim.x_m, layout.y_m + aim.y_m)
    within = [np.abs(angle_rad) <= range_rad for angle_rad in angles_rad]  # False for NaN, outside a calibrated field
    return np.asarray(within[0] & within[1], dtype=np.bool_)


def build_aim_map(aim: Aim, reached: BoolArray) -> PixelMap:
    """Return the pixel map that moves the beam of every pixel to an aim. Pixels that it does not reach stay."""
    unmoved = PixelMap.uniform(len(reached))
    return replace(unmoved, offset_x_m=np.where(reached, aim.x_m, 0.0), offset_y_m=np.where(reached, aim.y_m, 0.0))


def build_sweep(config: Config, aim: Aim, included: BoolArray) -> tuple[PulseTrain, ...]:
    """Build one pulse per included pixel, in an order without successive neighbours."""
    layout, (width_s, power_w) = build_pixel_layout(config.display), compute_pulse(config, aim)
    order = np.lexsort((layout.column, layout.row, layout.column % 2, layout.row % 2))
    slot_s = width_s + GATE_OFF_S
    return tuple(
        PulseTrain(int(pixel), round(k * slot_s, 6), width_s, width_s, GATE_OFF_S, power_w)
        for k, pixel in enumerate(order[included[order]])
    )
