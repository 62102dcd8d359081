"""Mirror steps with the gate off, to be recorded for `optodrive calibrate servo`.

Each run has steps of one size around the middle of the display, and each size has two runs: the calibration judges its
models by the second one, which no fit sees. The times of the commands are those that the board has
reported, so a trace that is triggered at the first step has their time line.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import InputError, LinkError
from optodrive.core.types.arrays import FloatArray, IntArray, ReadOnlyArrays
from optodrive.core.types.plans import PulsePlan
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard, find_weakest_pixel, max_settling_s
from optodrive.link.protocol.quantisation import CENTRE_CODE, GATE_OFF_STEP_TICKS, TICKS_MAX, WirePoints, WireScale
from optodrive.planning.limiter.limiter import galvo_feasible_prefix

SIZE_FRACTIONS = (1.0, 0.2, 0.033)
"""Sizes of the steps relative to the display: small ones determine the bandwidth, large ones the slew rate."""
ROUNDS = ("", "b")
"""Ends of the names of the runs. All sizes are played in the first round before any is played again."""
STEPS_MIN, STEPS_MAX = 6, 100
LEAD_IN_S = 0.1
"""Time at the first position before the first step, in which a mirror comes to rest; the first step's time."""
HOLD_S, HOLD_JITTER_S = 0.015, 1e-3
"""Time between steps, and the share of it that varies, so that steps are not synchronous with samples."""
HOLD_MAX_S = 1.0
HOLD_GROWTH = 1.25


@dataclass(frozen=True, eq=False)
class StepRun(ReadOnlyArrays):
    """Steps of one size.

    codes: [n, 2] of x and y, the first before any step
    hold_ticks: [n] time at each
    """

    name: str
    codes: IntArray
    hold_ticks: IntArray


def plan_step_runs(board: ExclusiveBoard, step_count: int) -> tuple[StepRun, ...]:
    """Plan the runs, two per size that differ in the times of their steps.

    Mirror x moves at every step and mirror y at every other one. Steps follow each other as fast as the mirrors settle
    and the galvo cap permits. Raises InputError for a number of steps outside STEPS_MIN to STEPS_MAX, or if they exceed
    the cap at HOLD_MAX_S.
    """
    if not STEPS_MIN <= step_count <= STEPS_MAX:
        raise InputError("--steps", step_count, f"{STEPS_MIN} to {STEPS_MAX}")
    number = np.arange(step_count + 1)
    signs = np.column_stack([np.where(number % 2 == 1, 1, -1), np.where((number + 1) // 2 % 2 == 1, 1, -1)])
    travel, random = np.array(board.half_travel_codes), np.random.default_rng(0)
    return tuple(
        _plan_run(
            board,
            f"size{k}{end}",
            CENTRE_CODE + signs * np.rint(fraction * travel),
            random.uniform(0.0, HOLD_JITTER_S, step_count),
        )
        for end in ROUNDS
        for k, fraction in enumerate(SIZE_FRACTIONS, 1)
    )


def _plan_run(board: ExclusiveBoard, name: str, codes: FloatArray, jitter_s: FloatArray) -> StepRun:
    display = board.display
    tick_s, state = board.session.scale.tick_s, display.build_cold_state()[1]
    hold_s = max(HOLD_S, max_settling_s(display.config))
    while hold_s <= HOLD_MAX_S:
        hold_ticks = np.rint(np.concatenate([[LEAD_IN_S], hold_s + jitter_s]) / tick_s).astype(np.int64)
        run = StepRun(name, codes.astype(np.int64), hold_ticks)
        if galvo_feasible_prefix(build_move_plan(run, board), state, display.budget) == len(codes):
            return run
        hold_s *= HOLD_GROWTH
    cap = display.config.limits.galvo_acceleration_rms_max_rad_per_s2
    key = "limits.galvo_acceleration_rms_max_rad_per_s2"
    raise InputError(key, cap, f"a cap that permits {len(codes) - 1} steps across the display, {HOLD_MAX_S:g} s apart")


def build_move_plan(run: StepRun, board: ExclusiveBoard) -> PulsePlan:
    """Build the moves as pulses without power at the ends of the holds, for the limiter.

    The limiter lets mirrors ring until a pulse begins: each takes half of its hold, or as much as the cap permits.
    """
    scale, count, pwm_hz = board.session.scale, len(run.codes), board.config.laser.pwm_hz
    hold_s = run.hold_ticks * scale.tick_s
    width_s = np.floor(np.minimum(0.5 * hold_s, board.config.limits.pulse_width_max_s) * pwm_hz * (1 + 1e-9)) / pwm_hz
    start_s = np.cumsum(hold_s) - width_s
    angles_rad = scale.to_angles_rad(run.codes)
    return PulsePlan(
        start_s=start_s,
        width_s=width_s,
        x_rad=angles_rad[:, 0].copy(),
        y_rad=angles_rad[:, 1].copy(),
        power_w=np.full(count, board.zero_duty_power_w),
        pixel=np.full(count, find_weakest_pixel(board.display)),
        settling_s=hold_s - width_s,
        target_m=np.full(count, np.nan),
        requested_start_s=start_s,
        source=np.zeros(count, dtype=np.int64),
        stage=np.zeros(count, dtype=np.int64),
    )


def build_gate_off_points(run: StepRun, scale: WireScale) -> WirePoints:
    """Build the points on the wire: gate-on time and duty of each are zero. A long hold takes several points."""
    rows = []
    outputs = np.column_stack(scale.to_outputs(*run.codes.T)).tolist()
    for (x_output, y_output), hold_ticks in zip(outputs, run.hold_ticks.tolist(), strict=True):
        rest_ticks = hold_ticks
        while rest_ticks > TICKS_MAX:  # the first point is long enough for any settling
            rows.append((x_output, y_output, GATE_OFF_STEP_TICKS, 0, 0))
            rest_ticks -= GATE_OFF_STEP_TICKS
        rows.append((x_output, y_output, rest_ticks, 0, 0))
    return WirePoints(np.array(rows, dtype=np.uint16), np.arange(len(rows)))


def play_run(run: StepRun, board: ExclusiveBoard) -> FloatArray:
    """Play a run on the armed board, and return its commands by the board's report: [n, 3] t_s, x_rad, y_rad.

    The first step is at LEAD_IN_S. Raises LinkError if the board held a position for another time than planned, which
    a recording could not show.
    """
    points = build_gate_off_points(run, board.session.scale)
    end_tick = board.play_gate_off(build_move_plan(run, board), points)
    held_ticks = np.diff(end_tick) - points.table[1:, 2].astype(np.int64)
    if held_ticks.any():
        late_us = float(np.abs(held_ticks).max()) * board.session.scale.tick_s * 1e6
        raise LinkError(f"{board.session.port}: a step was {late_us:g} µs late: play the steps again")
    step_s = LEAD_IN_S + np.concatenate([[0], np.cumsum(run.hold_ticks[1:-1])]) * board.session.scale.tick_s
    angles_rad = board.session.scale.to_angles_rad(run.codes)
    return np.column_stack([np.concatenate([[0.0], step_s]), angles_rad])


def play_step_runs(
    runs: tuple[StepRun, ...], board: ExclusiveBoard, pause_s: float, on_run: Callable[[StepRun, FloatArray], None]
) -> None:
    """Play all runs, with a pause after each, and report the commands of each to on_run."""
    for run in runs:
        on_run(run, play_run(run, board))
        board.wait(pause_s)
    board.move_to(CENTRE_CODE, CENTRE_CODE)
