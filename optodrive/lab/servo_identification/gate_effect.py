"""Settling times and the error that stays after a move of a nonlinear mirror, from simulated moves."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config
from optodrive.lab.servo_identification.common_servo import move_sizes_rad
from optodrive.lab.servo_identification.effect_fit import LINEAR, OTHER, STEPS_PER_TIME_CONSTANT, FormFit, Linearity
from optodrive.lab.servo_identification.effects import SLEW_LIMIT, integrate

CERTAIN = 0.95
HOLD_TIME_CONSTANTS = 40.0
"""Time at a position after a move, in 1/(ζω): the rest of a linear response is below 10⁻¹⁷."""
VISITS = 40
"""Moves between random positions, whose histories a hysteresis remembers."""
RESIDUAL_SIGMAS = 3.0
UNRESOLVED = "unresolved"


@dataclass(frozen=True, eq=False)
class MirrorEffect:
    """A mirror's effect at the gate.

    name: of the effect, LINEAR, OTHER or UNRESOLVED; error_rad: largest error that stays after a move; sizes_rad [k],
    distance_rad [k, n]: moves and the distance from the target at time_s [n] after each command, empty where the servo
    model says all
    """

    name: str
    linearity: Linearity
    error_rad: float
    sizes_rad: FloatArray
    time_s: FloatArray
    distance_rad: FloatArray

    def settling_s(self, move_rad: float, tolerance_rad: float) -> float:
        """Return the time after which all moves of about this size stay within error_rad + tolerance_rad, s."""
        if not len(self.time_s):
            return 0.0
        nearest = np.abs(np.log(self.sizes_rad / move_rad))
        outside = self.distance_rad[nearest <= nearest.min() + 1e-6] > self.error_rad + tolerance_rad
        last = np.flatnonzero(outside.any(axis=0))
        return float(self.time_s[min(last[-1] + 1, len(self.time_s) - 1)]) if len(last) else 0.0


def assess(linearity: Linearity, residual_rad: float, config: Config, axis: int) -> MirrorEffect:
    """Return a mirror's effect at the gate of a display.

    residual_rad: rms of the difference between recording and servo
    """
    name = max(linearity.probability, key=lambda each: linearity.probability[each])
    if linearity.probability[name] < CERTAIN and name != OTHER:
        name = UNRESOLVED
    none = np.zeros(0)
    if name in (LINEAR, SLEW_LIMIT):
        return MirrorEffect(name, linearity, 0.0, none, none, np.zeros((0, 0)))
    if name in (OTHER, UNRESOLVED):
        return MirrorEffect(name, linearity, RESIDUAL_SIGMAS * residual_rad, none, none, np.zeros((0, 0)))
    return MirrorEffect(name, linearity, *_simulate_moves(linearity.fits[name], config, axis))


def _simulate_moves(fit: FormFit, config: Config, axis: int) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Return the error that stays, and sizes [k], times [n] and distances [k, n] of moves across the display."""
    omega, zeta, delay_s = float(np.exp(fit.base[0])), fit.base[1], fit.base[2]
    h_s = 1.0 / (2 * STEPS_PER_TIME_CONSTANT * omega)
    slowest = zeta - np.sqrt(zeta * zeta - 1.0) if zeta > 1.0 else zeta
    hold = int(HOLD_TIME_CONSTANTS / (slowest * omega) / h_s)
    sizes = move_sizes_rad(config, axis)
    end = 0.5 * max(sizes)
    random = np.random.default_rng(0)
    places = [0.0, *random.uniform(-end, end, VISITS)]
    for size in sizes:
        for start in (-end, -0.5 * size, end - size):
            places += [start, start + size, start]
    target = np.array(places)
    drive = np.repeat(target, hold)
    system = np.array([[0.0, 1.0, 0.0], [-omega * omega, -2.0 * zeta * omega, 1.0], [0.0, 0.0, 0.0]])
    step, out = np.ascontiguousarray(expm(system * h_s)[:2]), np.empty(len(drive))
    integrate(fit.form.kind, *fit.effect, omega, zeta, step, drive, h_s, fit.scale, out)
    angle = out.reshape(len(target), hold)
    # The calibrated field absorbs gain and offset.
    model = np.column_stack([np.ones(len(target)), angle[:, -1]])
    offset, gain = np.linalg.lstsq(model, target, rcond=None)[0]
    distance = np.abs(offset + gain * angle - target[:, None])
    moves = np.abs(np.diff(target, prepend=0.0))
    is_size = (np.abs(moves[:, None] / np.array(sizes) - 1.0) < 1e-6).any(axis=1)
    stride = max(1, hold // 2000)
    times_s = np.asarray(delay_s + h_s * np.arange(1, hold + 1, stride), dtype=np.float64)
    return float(distance[:, -1].max()), moves[is_size], times_s, distance[is_size][:, ::stride]
