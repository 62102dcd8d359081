"""Smooth moves of a mirror: the command between two pixels that heats the mirror least, with light at both ends.

Theory of operation. A servo within its slew limit is linear: angle and acceleration at any time are weighted sums of
the samples of its command, which runs straight from one sample to the next. The integral of a², which heats the coil,
is a quadratic form of these samples. The gate is closed for the dark time of the move. Before it the mirror must be
within the tolerance of the pixel that it leaves, and after it within that of the pixel that it reaches: linear
inequalities, as is the slew limit. The least heat for a dark time is therefore a quadratic programme, and the smallest
dark time for a heat follows by bisection.

The servo is known only within its uncertainty. The inequalities hold for servos on a grid over natural frequency and
damping, and for every delay, because they extend over the dark time without the delay's half-width at either end.
A reserve of the tolerance covers servos between the grid's and residual ringing of earlier moves.

A move is computed for a distance. A shorter one is the same move, scaled: it stays within the tolerance and the slew
limit. So one table by whole pitches holds every move, and both axes of a diagonal move have the same dark time.
"""

from dataclasses import dataclass
from math import sqrt
from typing import Self

import clarabel
import numpy as np
from scipy.linalg import expm
from scipy.sparse import csc_matrix, triu

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.config import Config
from optodrive.device.servo import Servo, ServoRange
from optodrive.lab.servo_identification.gate import find_half_widths
from optodrive.lab.servo_identification.identify import IdentifiedServo
from optodrive.planning.budget_setup import build_galvo_model
from optodrive.planning.limiter.galvo_load import move_energy

SAMPLE_S = 1e-5
"""Interval of a command's samples, s."""
LEAD_SAMPLES = 30
"""Samples of a move before the gate closes, and after it opens again."""
REST_SAMPLES = 20
"""Samples after a move from which on its ringing stays within RINGING, and the next one may begin."""
RINGING_SAMPLES = 30
"""Samples for which that is required, three time constants: from there on ringing only decays."""
RINGING = 0.03
"""Share of the tolerance for the ringing of all earlier moves."""
RESERVE = 0.01
"""Share of the tolerance for servos between those of the grid."""
RINGING_OF_ONE = 0.9 * RINGING
"""Share for that of one move: it has decayed to less than a tenth when the next one is over."""
MIN_DWELL_S = (2 * LEAD_SAMPLES + REST_SAMPLES) * SAMPLE_S
"""Shortest light between two moves, s."""
GRID = (-1.0, 0.0, 1.0)
"""Places of the grid over the uncertainty, in half-widths."""
MISFIT_MAX = 1.1
"""Largest rms residual of an identified servo, times the noise."""
DARK_SAMPLES_MAX = 100
RAD_PER_UNIT = 1e-3
"""Unit of angle in the programme, rad: the solver takes numbers near one."""


def find_range(found: IdentifiedServo, tolerance_rad: float) -> ServoRange | None:
    """Return the range of a servo that `calibrate servo` identified, None if it does not suffice for smooth moves.

    It does not if the steps were too small to show the slew limit, if the delay is uncertain by more than a sample,
    if the model leaves a residual beyond the noise, or if the noise of every run could hide one beyond the reserve.
    """
    noise_rad = min(run.noise for run in found.trace.runs)
    is_noisy = noise_rad * sqrt(MISFIT_MAX**2 - 1.0) > RESERVE * tolerance_rad
    frequency, damping, _, delay_s = find_half_widths((found, found), found.servo)
    if is_noisy or delay_s > SAMPLE_S or not found.slew_identified or found.misfit > MISFIT_MAX:
        return None
    return ServoRange(found.servo, frequency, damping, 0.0, SAMPLE_S)


def list_grid(servos: ServoRange) -> list[Servo]:
    """Return the servos of the grid over frequency and damping."""
    return [
        servos.servo_at(frequency, damping, 0.0, 0.0)
        for frequency in (GRID if servos.frequency else (0.0,))
        for damping in (GRID if servos.damping else (0.0,))
    ]


@dataclass(frozen=True, eq=False)
class SmoothMove:
    """The command of a move, [n] samples at SAMPLE_S, from 0 to the distance, both of which it holds outside.

    The first sample is sent LEAD_SAMPLES before the gate closes, less the servo's delay. dark_samples: samples until it
    opens again; heat: integral of a² of the servo in the middle of its range, rad²/s³
    """

    command_rad: FloatArray
    dark_samples: int
    heat: float

    @property
    def dark_s(self) -> float:
        """Time for which the gate is closed, s."""
        return self.dark_samples * SAMPLE_S

    @property
    def distance_rad(self) -> float:
        """Distance of the move, rad."""
        return float(self.command_rad[-1])


def respond(servo: Servo, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the matrices from `count` samples of a command, from rest at 0, to angle and acceleration at each.

    The servo's delay is not included.
    """
    omega = 2.0 * np.pi * servo.frequency
    system = np.zeros((4, 4))  # angle, speed, command and the command's slope
    system[:2, :3] = [[0.0, 1.0, 0.0], [-(omega**2), -2.0 * servo.damping * omega, omega**2]]
    system[2, 3] = 1.0
    step = expm(system * SAMPLE_S)
    now, slope = step[:2, 2], step[:2, 3] / SAMPLE_S
    state, states = np.zeros((2, count)), np.zeros((count, 2, count))
    for k in range(1, count):
        state = step[:2, :2] @ state
        state[:, k - 1] += now - slope
        state[:, k] += slope
        states[k] = state
    angle, speed = states[:, 0], states[:, 1]
    return angle, omega**2 * (np.eye(count) - angle) - 2.0 * servo.damping * omega * speed


def compute_move(
    servos: ServoRange, distance_rad: float, tolerance_rad: float, dark_samples: int, is_alone: bool = False
) -> SmoothMove | None:
    """Compute the move of least heat with this dark time, None if there is none.

    is_alone: without a move before or after it, so that nothing of the tolerance is reserved
    """
    servo, command_count = servos.servo, 2 * LEAD_SAMPLES + dark_samples + 1
    count = command_count + REST_SAMPLES + RINGING_SAMPLES
    # A command holds its last sample.
    hold = np.eye(command_count)[np.minimum(np.arange(count), command_count - 1)]
    sample = np.arange(count) - LEAD_SAMPLES  # from the gate's closing on
    delay_samples = round(servos.delay_s / SAMPLE_S)
    is_leaving = sample <= delay_samples
    is_arriving = sample >= dark_samples - delay_samples
    is_over = sample >= command_count - 1 - LEAD_SAMPLES + REST_SAMPLES
    reach = (1.0 if is_alone else 1.0 - RESERVE - RINGING) * tolerance_rad
    parts = [(is_leaving, 0.0, reach), (is_arriving, distance_rad, reach)]
    if not is_alone:
        parts.append((is_over, distance_rad, RINGING_OF_ONE * tolerance_rad))
    rows, limits = [], []
    for servo_of_grid in list_grid(servos):
        angle = respond(servo_of_grid, count)[0] @ hold
        for part, target_rad, reach_rad in parts:
            some = angle[part & (sample > sample[0])]
            rows += [some, -some]
            limits += [np.full(len(some), reach_rad + target_rad), np.full(len(some), reach_rad - target_rad)]
    slope = np.diff(np.eye(command_count), axis=0)
    rows += [slope, -slope]
    limits += [np.full(2 * len(slope), servo.slew * SAMPLE_S)]
    acceleration = respond(servo, count)[1] @ hold
    solution = _solve(
        form=acceleration.T @ acceleration,
        matrix=np.vstack([np.eye(command_count)[[0, -1]], *rows]),
        limit=np.concatenate([[0.0, distance_rad], *limits]),
    )
    if solution is None:
        return None
    heat = float(((acceleration @ solution) ** 2).sum() * SAMPLE_S)
    return SmoothMove(solution, dark_samples, heat)


def _solve(form: FloatArray, matrix: FloatArray, limit: FloatArray) -> FloatArray | None:
    """Minimise the quadratic form where matrix @ x ≤ limit, with equality in the first two rows."""
    cones = [clarabel.ZeroConeT(2), clarabel.NonnegativeConeT(len(limit) - 2)]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    quadratic, count = csc_matrix(triu(form / np.abs(form).max())), form.shape[0]
    limit = limit / RAD_PER_UNIT
    solution = clarabel.DefaultSolver(quadratic, np.zeros(count), csc_matrix(matrix), limit, cones, settings).solve()
    return np.array(solution.x) * RAD_PER_UNIT if solution.status == clarabel.SolverStatus.Solved else None


def find_fastest_move(servos: ServoRange, distance_rad: float, tolerance_rad: float, heat_max: float) -> SmoothMove:
    """Return the move with the smallest dark time whose heat is at most heat_max, rad²/s³.

    Raises InputError if no move has it.
    """
    # Not even at the slew limit is the way between the two pixels' tolerances shorter.
    low = int(max(0.0, distance_rad - 2.0 * tolerance_rad) / (servos.servo.slew * SAMPLE_S))
    high, best = DARK_SAMPLES_MAX, None
    while low < high:
        middle = (low + high) // 2
        move = compute_move(servos, distance_rad, tolerance_rad, middle)
        if move is not None and move.heat <= heat_max:
            high, best = middle, move
        else:
            low = middle + 1
    if best is None:
        longest_s = (DARK_SAMPLES_MAX - 1) * SAMPLE_S
        expected = f"a distance with a move of at most {heat_max:.3g} rad²/s³ in {longest_s:.2g} s"
        raise InputError("distance_rad", distance_rad, expected)
    return best


@dataclass(frozen=True, eq=False)
class SmoothTable:
    """Moves by whole pitches and a code of rounding, from 1 pitch on. Other distances take the next longer, scaled."""

    servos: ServoRange
    pitch_rad: float
    code_rad: float
    moves: tuple[SmoothMove, ...]

    @classmethod
    def from_config(cls, config: Config, servos: ServoRange, pitches_max: int, heat_ratio: float) -> Self:
        """Compute the moves of up to pitches_max pitches with at most heat_ratio times the heat of the same step."""
        scanner = config.scanner
        pitch_rad = config.display.pitch_m / (2.0 * scanner.focal_length_m)
        tolerance_rad = min(config.tolerance_rad) - scanner.rad_per_code
        galvo = build_galvo_model(config)
        ways_rad = [pitches * pitch_rad + scanner.rad_per_code for pitches in range(1, pitches_max + 1)]
        heats = [heat_ratio * move_energy(galvo, way_rad) for way_rad in ways_rad]
        moves = (
            find_fastest_move(servos, way_rad, tolerance_rad, heat)
            for way_rad, heat in zip(ways_rad, heats, strict=True)
        )
        return cls(servos, pitch_rad, scanner.rad_per_code, tuple(moves))

    def index_moves(self, way_rad: FloatArray) -> IntArray:
        """Return the index of the move for each displacement in x and y, [n, 2]; the longer axis decides."""
        longest_rad = np.abs(way_rad).max(axis=1) - self.code_rad
        return np.maximum(np.ceil(longest_rad / self.pitch_rad - 1e-6).astype(np.int64), 1) - 1

    def dark_s(self, way_rad: FloatArray) -> FloatArray:
        """Return the dark time of each displacement in x and y, [n, 2], s."""
        return np.array([move.dark_s for move in self.moves])[self.index_moves(way_rad)]

    def build_command(
        self, close_s: FloatArray, from_rad: FloatArray, to_rad: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return times [m] and angles [m, 2] between which the command runs straight.

        close_s: [n] times at which the gate closes; from_rad, to_rad: [n, 2]. From one time to the next pass at least
        the dark time of the move between and MIN_DWELL_S.
        """
        way_rad = to_rad - from_rad
        index = self.index_moves(way_rad)
        lengths = np.array([len(move.command_rad) for move in self.moves])
        shapes = np.concatenate([move.command_rad / move.distance_rad for move in self.moves])
        count = lengths[index]
        pulse = np.repeat(np.arange(len(index)), count)
        sample = np.arange(len(pulse)) - (np.cumsum(count) - count)[pulse]
        begin_s = close_s - LEAD_SAMPLES * SAMPLE_S - self.servos.servo.delay
        share = shapes[(np.cumsum(lengths) - lengths)[index][pulse] + sample]
        return begin_s[pulse] + sample * SAMPLE_S, from_rad[pulse] + share[:, None] * way_rad[pulse]
