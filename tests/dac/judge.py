"""Independent judge of a DAC's log of samples: where its light falls, how much of it there is, and what it heats.

Servo and thermal display are those that judge the boards. Nothing of encoder, proof and drivers is used.
"""

from dataclasses import dataclass

import numpy as np

from focus_judge import compute_overhang_m, ideal_position_m
from reference_models.thermal_display import galvo_peak, window_peak_w

CODES = 2047.0
CENTRE_CODE = 2048


@dataclass(frozen=True)
class Light:
    """Stretches of light [n] of a log, in the device's time: what was emitted, and the mirror commands [m] around it.

    plan_s: time in the plan of each, by the number of the sample
    """

    start_s: np.ndarray
    width_s: np.ndarray
    power_w: np.ndarray
    x_rad: np.ndarray
    y_rad: np.ndarray
    pixel: np.ndarray
    stage: np.ndarray
    plan_s: np.ndarray
    moves_s: np.ndarray
    moves_rad: tuple

    def __len__(self):
        return len(self.start_s)


def read_light(table, display, sample_s, first_sample=0):
    """Read a log. sample_s: nominal period of a sample; first_sample: number of the plan's first one."""
    rad_per_code = display.config.scanner.range_rad / CODES
    from_s, until_s, sample, x, y, level = table.T
    x_rad, y_rad = (x - CENTRE_CODE) * rad_per_code, (y - CENTRE_CODE) * rad_per_code
    moved = np.append(True, (np.diff(table[:, 3:5], axis=0) != 0).any(axis=1))
    is_on = level > 0
    # Light that goes on while the mirrors are told to leave still falls where it was: one stretch.
    goes_on = np.append(False, is_on[1:] & is_on[:-1] & moved[1:] & (from_s[1:] - until_s[:-1] < 1e-9))
    until_s = until_s.copy()
    for row in np.flatnonzero(goes_on)[::-1]:
        until_s[row - 1] = until_s[row]
    is_on &= ~goes_on
    at_m = np.column_stack(ideal_position_m(display, x_rad[is_on], y_rad[is_on]))
    places_m = np.column_stack([display.layout.x_m, display.layout.y_m])
    pixel = np.array([int(np.argmin(((places_m - at) ** 2).sum(axis=1))) for at in at_m], dtype=np.int64)
    return Light(
        start_s=from_s[is_on],
        width_s=(until_s - from_s)[is_on],
        power_w=level[is_on] * display.config.laser.max_power_w,
        x_rad=x_rad[is_on],
        y_rad=y_rad[is_on],
        pixel=pixel,
        stage=np.zeros(len(pixel), dtype=np.int64),
        plan_s=(sample[is_on] - first_sample) * sample_s,
        moves_s=from_s[moved],
        moves_rad=(x_rad[moved], y_rad[moved]),
    )


def find_rows(light, plan):
    """Return the plan row of each stretch. It must lie in the planned pulse, on its pixel."""
    row = np.searchsorted(plan.start_s, light.plan_s + 1e-9, side="right") - 1
    assert (row >= 0).all(), "light before the plan"
    assert (light.plan_s < (plan.start_s + plan.width_s)[row]).all(), "light after a pulse"
    assert (light.pixel == plan.pixel[row]).all(), "light on another pixel"
    return row


def judge(light, plan, display):
    """Judge whole plans: place, energy and power of each pulse. Return the emitted energy, J, and the overhang, m."""
    row = find_rows(light, plan)
    emitted_j = np.bincount(row, light.power_w * light.width_s, minlength=len(plan))
    excess = emitted_j - plan.energy_j
    assert excess.max(initial=-1.0) <= 1e-12, f"{excess.max()} J above the plan"
    assert (light.power_w <= plan.power_w[row] * (1 + 1e-9)).all()
    return emitted_j.sum(), judge_place(light, display)


def judge_place(light, display, rows=2000):
    """Return how far the focus extends beyond an absorber, m; negative if it never does."""
    worst_m = -np.inf
    for first in range(0, len(light), rows):
        some = slice(first, first + rows)
        worst_m = max(
            worst_m,
            compute_overhang_m(
                display, light.moves_s, light.moves_rad, light.start_s[some], light.width_s[some], light.pixel[some]
            ),
        )
    return worst_m


def judge_caps(light, display, true_display):
    """Judge the caps by an integrator that shares no code with the limiter. true_display: of the worst parameters."""
    caps = display.budget.caps
    absorber_k, _, wall_k, touch_k, panel_k = true_display.peaks(light)
    assert absorber_k <= caps.absorber_k
    assert wall_k <= caps.wall_k
    assert max(wall_k, touch_k, panel_k) <= caps.touch_k
    limits = display.config.limits
    assert window_peak_w(light, limits.display_mean_window_s) <= limits.display_mean_power_max_w * (1 + 1e-9)
    assert galvo_peak(light, display.budget) <= caps.galvo_rad2_per_s4
