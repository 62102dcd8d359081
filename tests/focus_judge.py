"""Independent judge of where the focus is while the gate is on, by an exact servo."""

from dataclasses import dataclass

import numpy as np

GRID_S = 1e-6


@dataclass(frozen=True)
class ExactServo:
    """Servo by its matrix exponential. The state [angle, speed] is relative to the target, at rest or slewing."""

    scanner: object

    def angles(self, at_s, target_rad, t_s):
        """Return the angle at t_s of a servo that starts at 0 and is commanded to target_rad at at_s."""
        omega, damping = 2 * np.pi * self.scanner.bandwidth_hz, self.scanner.damping
        rates, vectors = np.linalg.eig(np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]]))
        inverse = np.linalg.inv(vectors)

        def propagate(state, after_s):
            return ((vectors * (inverse @ state)) @ np.exp(np.outer(rates, after_s))).real

        angles_rad, target, state = np.zeros(len(t_s)), 0.0, np.zeros(2)
        begins_s = at_s + self.scanner.delay_s
        ends_s = np.append(begins_s[1:], np.inf)
        for begin_s, end_s, step_target in zip(begins_s, ends_s, target_rad, strict=True):
            run_s = min(abs(step_target - target) / self.scanner.slew_rad_per_s, end_s - begin_s)
            slew_rate = self.scanner.slew_rad_per_s * np.sign(step_target - target)
            for from_s, to_s, target_rate in ((begin_s, begin_s + run_s, slew_rate), (begin_s + run_s, end_s, 0.0)):
                steady = np.array([target - 2 * damping / omega * target_rate, target_rate])
                rows = slice(*np.searchsorted(t_s, [from_s, to_s]))
                after_s = t_s[rows] - from_s
                angles_rad[rows] = propagate(state - steady, after_s)[0] + steady[0] + target_rate * after_s
                if np.isfinite(to_s):
                    transient = propagate(state - steady, np.array([to_s - from_s]))[:, 0]
                    state = transient + steady + np.array([target_rate * (to_s - from_s), 0.0])
                    target += target_rate * (to_s - from_s)
        return angles_rad


def ideal_position_m(display, x_rad, y_rad):
    """Return the beam's position with an ideal lens."""
    twice_f_m = 2.0 * display.config.scanner.focal_length_m
    return twice_f_m * x_rad, twice_f_m * y_rad


def compute_overhang_m(display, begin_s, angles_rad, from_s, width_s, pixel_of, position_of=ideal_position_m):
    """Return the overhang of mirrors commanded to angles_rad (x, y) at begin_s, m.

    The gate is on from from_s for width_s on pixel_of.
    """
    config = display.config
    if not len(from_s):
        return -np.inf
    # Edges of the gate and a grid between them, fine while the servo may still ring.
    samples, row_of = [], []
    for row, on_s in enumerate(width_s):
        inside_s = np.append(np.arange(0.0, min(on_s, 3e-3), GRID_S), np.linspace(0.0, on_s, 50))
        samples.append(from_s[row] + np.sort(inside_s))
        row_of.append(np.full(len(inside_s), row))
    t_s, row_of = np.concatenate(samples), np.concatenate(row_of)
    pixel = pixel_of[row_of]
    display_section, laser, servo = config.display, config.laser, ExactServo(config.scanner)
    overhangs_m = []
    landed_m = position_of(display, *(servo.angles(begin_s, target_rad, t_s) for target_rad in angles_rad))
    for at_m, place_m, absorber_m, focus_m in (
        (landed_m[0], display.layout.x_m, display_section.absorber_width_m, laser.focus_width_m),
        (landed_m[1], display.layout.y_m, display_section.absorber_height_m, laser.focus_height_m),
    ):
        off_m = np.abs(at_m - place_m[pixel])
        overhangs_m.append((off_m + config.scanner.aim_error_m + focus_m / 2 - absorber_m / 2).max())
    return max(overhangs_m)
