"""What to play so that every pixel's gain and offset can be told: one pulse a pixel, at a few aims.

Across an edge part of the focus misses the absorber, which no limiter counts with: it falls on the wall, or on what
lies there. Those pulses are so faint that even black acrylic would stay below the wall's cap.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.types.stimuli import PulseTrain
from optodrive.device.config import Config, build_pixel_layout
from optodrive.lab.calibration.pixels.fit import Optics

EDGE_FRACTIONS = (0.7, 0.3)
"""How much of the focus is nominally left on the absorber where the beam is aimed across an edge."""
ENERGY_FRACTION = 0.1
"""Of the largest pulse allowed, for pulses on the middle."""
WALL_HEADROOM_FRACTION = 0.8
"""Of the room below limits.wall_max_c, for pulses part of which miss the absorber."""
ACRYLIC_EFFUSIVITY_W_S05_PER_M2_K = (0.19 * 1.75e6) ** 0.5
"""Thermal effusivity of acrylic: 0.19 W/(m K), and 1.75 MJ/(m³ K), Table S4."""
GATE_OFF_S = 0.05
"""From a pulse's end to the next pulse on any pixel: the gas and absorber are cold again after a few of them."""


class Aim(NamedTuple):
    """Where the beam is sent from each pixel's middle, m; name: of its files."""

    name: str
    x_m: float
    y_m: float


def list_aims(config: Config) -> list[Aim]:
    """The middle, and two places across each edge."""
    optics = Optics.from_config(config)
    edge_offsets_m = [
        [optics.absorber_half_m[axis] + (1.0 - 2.0 * share) * optics.focus_half_m[axis] for share in EDGE_FRACTIONS]
        for axis in range(2)
    ]
    aims = [Aim("middle", 0.0, 0.0)]
    for sign, suffix in ((-1.0, "minus"), (1.0, "plus")):
        aims += [Aim(f"x-{suffix}-{k}", round(sign * off_m, 9), 0.0) for k, off_m in enumerate(edge_offsets_m[0], 1)]
        aims += [Aim(f"y-{suffix}-{k}", 0.0, round(sign * off_m, 9)) for k, off_m in enumerate(edge_offsets_m[1], 1)]
    return aims


def compute_pulse(config: Config, aim: Aim) -> tuple[float, float]:
    """Width, s, and power, W, of the pulses of an aim: short ones on the middle, faint ones across an edge."""
    laser, limits = config.laser, config.limits
    if aim.x_m == aim.y_m == 0.0:
        energy_j = ENERGY_FRACTION * limits.pulse_energy_max_j
        periods = max(1, int(energy_j / laser.max_power_w * laser.pwm_hz))
        width_s = min(periods / laser.pwm_hz, limits.pulse_width_max_s)
        return width_s, min(laser.max_power_w, energy_j / width_s)
    width_s = int(limits.pulse_width_max_s * laser.pwm_hz + 1e-6) / laser.pwm_hz
    return width_s, edge_power_max_w(config, width_s)


def edge_power_max_w(config: Config, width_s: float) -> float:
    """The power at which a wall that takes in all the light stays below its cap, W; room √t / e of a half-space.

    Mean and ripple of the PWM are added: both grow as the root of how long they last.
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


def build_sweep(config: Config, aim: Aim) -> tuple[PulseTrain, ...]:
    """One pulse a pixel; no two beside each other follow one another."""
    layout, (width_s, power_w) = build_pixel_layout(config.display), compute_pulse(config, aim)
    order = np.lexsort((layout.column, layout.row, layout.column % 2, layout.row % 2))
    slot_s = width_s + GATE_OFF_S
    return tuple(
        PulseTrain(int(pixel), round(k * slot_s, 6), width_s, width_s, GATE_OFF_S, power_w)
        for k, pixel in enumerate(order)
    )
