"""The servo and the resting error by which plans open the gate: one for both mirrors, no faster than either.

Settling times and the error of a nonlinear mirror are those of simulated moves across the display.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, exp, pi, sin, sqrt

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import DAMPING_MAX, Config
from optodrive.device.config_sections import ServoSection
from optodrive.device.gate_timing import build_servo, settling_s
from optodrive.device.servo import Servo
from optodrive.lab.servo_identification.amplitude_response import CoupledAxes
from optodrive.lab.servo_identification.effect_fit import LINEAR, OTHER, STEPS_MAX, STEPS_PER_TIME_CONSTANT, Linearity
from optodrive.lab.servo_identification.effects import SLEW_LIMIT, NonlinearServo, Pair, build_drive
from optodrive.lab.servo_identification.identify import IdentifiedServo

DAMPING_MIN, COMMON_DAMPING_MAX = 0.3, 0.9
"""Range of the configuration."""
FREQUENCY_MIN_HZ = 100.0
TOLERANCE_SHARES = (1.0, 0.75, 0.5)
"""Shares of the gate's tolerance at which settling is compared; former moves may use the rest."""
MOVE_SIZE_COUNT = 8
FREQUENCY_STEP = 0.995
SIGMAS = 3.0
"""Half-width of an identified parameter, in its standard deviations."""
HALF_WIDTH_MIN, HALF_WIDTH_MAX = 0.02, 0.3
"""Range of relative half-widths."""
UNMEASURED_HALF_WIDTH = float(ServoSection.model_fields["slew_uncertainty"].default)
DELAY_HALF_WIDTH_MIN_S = 1e-5
"""A sample of a servo's digital driver, s."""
SETTLING_SLACK = 1.001
"""Permitted ratio of required to actual settling time."""
HOLD_TIME_CONSTANTS = 40.0
"""Time at a position after a move, in 1/(ζω): the rest of a linear response is below 10⁻¹⁷."""
RINGING_MIN = 1e-3
"""Ringing after a move, relative to it, below which a mode counts as error in place of time."""
VISITS = 40
"""Moves between random positions, whose histories a hysteresis remembers."""
RESIDUAL_SIGMAS = 3.0
UNRESOLVED = "unresolved"
Mirrors = tuple[IdentifiedServo, IdentifiedServo]
Move = tuple[float, float, int]
"""Size and tolerance, rad, and axis."""
Settle = Callable[[int, float, float], float]
"""Settling time, s, by axis, size and tolerance of a move."""


@dataclass(frozen=True)
class CommonServo:
    """A servo model for both mirrors.

    galvo_share: factor on the galvo cap, since the faster mirror accelerates more than the model
    settling_excess: of x and y, relative excess of the model's mean settling time over the mirror's own
    """

    servo: Servo
    galvo_share: float
    settling_excess: Pair


def find_common_servo(
    mirrors: Mirrors, config: Config, settle: Settle = lambda axis, move_rad, tolerance_rad: 0.0
) -> CommonServo:
    """Find the servo with the smallest mean settling time that covers the 95 % intervals of both mirrors.

    Moves range from one pitch to the whole display, at the gate's tolerances.

    settle: further lower bound of the settling time of a move of an axis, s
    """
    moves = _list_moves(config)
    bounds_s = [
        (mirrors[axis].settling_s(step, tolerance)[2], settle(axis, step, tolerance)) for step, tolerance, axis in moves
    ]
    required_s = np.max(bounds_s, axis=1)
    delay_s, slew = max(each.servo.delay for each in mirrors), min(each.servo.slew for each in mirrors)
    starts = [replace(mirror.servo, delay=delay_s, slew=slew) for mirror in mirrors]
    candidates = [_slow_to_required(start, moves, required_s) for start in starts]
    servo = min(candidates, key=lambda each: float(_settling_times_s(each, moves).mean()))
    pairs = ((each.servo, step) for each in mirrors for step, _, _ in moves)
    ratio = max(_acceleration_energy(own, step) / _acceleration_energy(servo, step) for own, step in pairs)
    return CommonServo(servo, min(1.0, 1.0 / sqrt(ratio)), _settling_excess(mirrors, servo, moves))


def _list_moves(config: Config) -> list[Move]:
    """Return size, tolerance and axis of the moves at which settling is compared."""
    return [
        (step_rad, share * tolerance_rad, axis)
        for axis, tolerance_rad in enumerate(config.tolerance_rad)
        for step_rad in move_sizes_rad(config, axis)
        for share in TOLERANCE_SHARES
    ]


def bound_coupled_moves(axes: CoupledAxes, angle_per_output: FloatArray, config: Config) -> tuple[Servo, Pair]:
    """Return a servo that settles no sooner than coupled axes at any measured amplitude, and the errors that stay, rad.

    angle_per_output: [2, o]. Commands are those that turn the mirrors by their size at the model's own amplitude, since
    the calibrated field absorbs gains. What stays of a move is the change of its end with the amplitude, what
    creeps, and the model's error between amplitudes. Raise InputError for moves that settle too slowly for any servo.
    """
    model, zero = axes.model, np.zeros(1)
    drive = np.linalg.pinv(angle_per_output @ model.at(model.level, zero)[0].real)
    ringing = np.max([model.measure_ringing(float(level), angle_per_output, drive) for level in axes.levels], axis=0)
    moves_with_amplitude = np.arange(len(ringing)) < len(model.poles)
    rings = moves_with_amplitude & (ringing > RINGING_MIN)
    poles = np.concatenate([model.list_poles(float(level))[rings] for level in axes.levels])
    if not len(poles) or poles.real.max() >= 0.0:
        raise InputError("response", "no mode, or one that does not decay", "modes that decay: more realisations")
    count = min(int(HOLD_TIME_CONSTANTS * model.rate_hz / -poles.real.max()), STEPS_MAX) + 1
    turns, slow_turns = (
        [angle_per_output @ model.respond_to_step(float(level), count, each) @ drive for level in axes.levels]
        for each in (rings, rings | ~moves_with_amplitude)
    )
    required_s = np.zeros(len(moves := _list_moves(config)))
    for row, (size_rad, tolerance_rad, axis) in enumerate(moves):
        allowed = np.array(config.tolerance_rad) * (tolerance_rad / config.tolerance_rad[axis]) / size_rad
        for turn in turns:
            outside = (np.abs(turn[:, :, axis] - turn[-1, :, axis]) > allowed).any(axis=1)
            required_s[row] = max(required_s[row], np.flatnonzero(np.append(True, outside))[-1] / model.rate_hz)
    # Background poles creep for as long as the lowest line of the excitation: that is error, not time to wait for.
    begin = int(required_s.min() * model.rate_hz)
    creep = max(float(np.abs(slow - fast)[begin:].max()) for slow, fast in zip(slow_turns, turns, strict=True))
    share = axes.error_between + creep + float(ringing[moves_with_amplitude & ~rings].sum())
    miss = np.max([np.abs(turn[-1] - np.eye(2)) for turn in turns], axis=0) + share * np.eye(2)
    error_rad = miss @ [max(move_sizes_rad(config, axis)) for axis in range(2)]
    return _slow_to_required(build_servo(config.scanner), moves, required_s), (float(error_rad[0]), float(error_rad[1]))


def find_half_widths(mirrors: Mirrors, servo: Servo) -> tuple[float, float, float, float]:
    """Return the half-widths of frequency, damping, slew (relative) and delay (s) within which plans take the servo.

    They are three standard deviations, and at least what temperature may change; the delay's at least a sample of the
    servo's driver. A slew that the recording does not show keeps the half-width of one that was never measured.
    """
    frequency, damping, delay_s, inverse_slew = SIGMAS * np.max([each.sigma for each in mirrors], axis=0)
    slew = servo.slew * inverse_slew if all(each.slew_identified for each in mirrors) else UNMEASURED_HALF_WIDTH
    relative = np.clip([frequency, damping / servo.damping, slew], HALF_WIDTH_MIN, HALF_WIDTH_MAX).tolist()
    relative[1] = min(relative[1], DAMPING_MAX / servo.damping - 1.0)
    return *relative, max(float(delay_s), DELAY_HALF_WIDTH_MIN_S)


def move_sizes_rad(config: Config, axis: int) -> list[float]:
    """Return sizes of moves along one axis from one pitch to the whole display, rad."""
    display = config.display
    pitch_rad = display.pitch_m / (2.0 * config.scanner.focal_length_m)
    farthest = max(1, (display.columns, display.rows)[axis] - 1)
    pitches: list[float] = np.unique(np.geomspace(1, farthest, MOVE_SIZE_COUNT).round()).tolist()
    return [pitch_rad * pitch_count for pitch_count in pitches]


def _slow_to_required(start: Servo, moves: list[Move], required_s: FloatArray) -> Servo:
    """Lower the frequency of a servo until it settles as required. Raise InputError below the range of a file."""
    servo = replace(start, damping=min(max(start.damping, DAMPING_MIN), COMMON_DAMPING_MAX))
    while True:
        settling_s = _settling_times_s(servo, moves) * SETTLING_SLACK
        if np.all(settling_s >= required_s):
            return servo
        if servo.frequency * FREQUENCY_STEP < FREQUENCY_MIN_HZ:
            worst = int(np.argmax(required_s - settling_s))
            slowest = f"{FREQUENCY_MIN_HZ:g} Hz, the slowest in a file"
            expected = f"at most {1e3 * settling_s[worst]:.3g} ms, those of {slowest}"
            raise InputError("settling time", f"{1e3 * required_s[worst]:.3g} ms", expected)
        servo = replace(servo, frequency=servo.frequency * FREQUENCY_STEP)


def _settling_times_s(servo: Servo, moves: list[Move]) -> FloatArray:
    return np.array([settling_s(servo, step, tolerance) for step, tolerance, _ in moves])


def _settling_excess(mirrors: Mirrors, servo: Servo, moves: list[Move]) -> Pair:
    def excess(axis: int) -> float:
        mine = [move for move in moves if move[2] == axis]
        times_s = (_settling_times_s(each, mine).mean() for each in (servo, mirrors[axis].servo))
        return float(next(times_s) / next(times_s)) - 1.0

    return excess(0), excess(1)


def _acceleration_energy(servo: Servo, move_rad: float) -> float:
    """Return the integral of the squared acceleration of a move, rad²/s³, as the limiter computes it."""
    omega, damping = 2.0 * pi * servo.frequency, servo.damping
    root = sqrt(1.0 - damping**2)
    phase = min(omega * root * move_rad / servo.slew, pi)
    overlap = exp(-phase * damping / root) * (cos(phase) + damping / root * sin(phase))
    return servo.slew**2 * omega / (2.0 * damping) * (1.0 - overlap)


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
    name = linearity.effect or (OTHER if linearity.claim.verdict == "unexplained" else UNRESOLVED)
    if name in (LINEAR, SLEW_LIMIT, OTHER, UNRESOLVED):
        error_rad = 0.0 if name in (LINEAR, SLEW_LIMIT) else RESIDUAL_SIGMAS * residual_rad
        return MirrorEffect(name, linearity, error_rad, np.zeros(0), np.zeros(0), np.zeros((0, 0)))
    return MirrorEffect(name, linearity, *_simulate_moves(linearity.fits[name].servo, config, axis))


def _simulate_moves(
    servo: NonlinearServo, config: Config, axis: int
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Return the error that stays, and sizes [k], times [n] and distances [k, n] of moves across the display."""
    omega, zeta, delay_s = float(np.exp(servo.base[0])), float(servo.base[1]), float(servo.base[2])
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
    begin_s = np.asarray(h_s * hold * np.arange(len(target)), dtype=np.float64)
    drive = build_drive(servo.form, servo.effect, begin_s, target, (0.0, h_s, len(target) * hold))
    states = servo.respond(drive, h_s)
    angle = states[:, 0].reshape(len(target), hold)
    # The calibrated field absorbs gain and offset.
    model = np.column_stack([np.ones(len(target)), angle[:, -1]])
    offset, gain = np.linalg.lstsq(model, target, rcond=None)[0]
    distance = np.abs(offset + gain * angle - target[:, None])
    moves = np.abs(np.diff(target, prepend=0.0))
    is_size = (np.abs(moves[:, None] / np.array(sizes) - 1.0) < 1e-6).any(axis=1)
    stride = max(1, hold // 2000)
    times_s = np.asarray(delay_s + h_s * np.arange(1, hold + 1, stride), dtype=np.float64)
    return float(distance[:, -1].max()), moves[is_size], times_s, distance[is_size][:, ::stride]
