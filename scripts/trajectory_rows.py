"""Rows of the order benchmark: steps, jerk-limited moves (ruckig) and smooth moves, beside each other.

Each is judged by the same servos: the gate is closed for as long as one of them may be outside the tolerance of the
pixel that it leaves or reaches. Steps are sent when the gate closes, early steps as soon as the gate permits. The servo
is known exactly, or has natural frequency and damping within 5 or 10 % and a delay of one sample more or less. A
jerk-limited move is the path of the mirror; its command follows from the servo. The limit is the move of least heat
alone, without others before and after it.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np
from ruckig import InputParameter, Ruckig, Trajectory
from smooth_moves import (
    SAMPLE_S,
    SmoothTable,
    compute_move,
    find_fastest_move,
    list_grid,
    respond,
)

from optodrive.device.gate_timing import build_servo
from optodrive.device.servo import ServoRange

UNCERTAINTIES = {"exact": (0.0, 0.0), "±5 %": (0.05, SAMPLE_S), "±10 %": (0.1, SAMPLE_S)}
SETTLING_SAMPLES = 100
PLATEAUS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Limits of the acceleration, times the largest one that the jerk alone permits."""
FRAME_HEIGHT_M = 50e-6
FRAME_PITCHES_MAX = 2
FRAME_HEAT_RATIO = 1.3
"""Heat of a frame's moves, times that of the same steps."""
TRAIN_DARK_SAMPLES, TRAIN_RATE_HZ = 25, 800.0
"""Pulses of 1 ms at this rate leave this dark time."""


@dataclass(frozen=True)
class JudgedCommand:
    """Samples of a command until a servo may leave and until all have arrived, and its heat, rad²/s³."""

    leave: int
    arrive: int
    heat: float

    @property
    def dark_samples(self):
        """Samples for which the gate is closed."""
        return self.arrive - self.leave


def judge_command(servos, command_rad, distance_rad, tolerance_rad):
    """Judge a command [n] that ends at distance_rad by all servos."""
    command_rad = np.append(command_rad, np.full(SETTLING_SAMPLES, distance_rad))
    leave, arrive = len(command_rad), 0
    for servo in list_grid(servos):
        angle_rad = respond(servo, len(command_rad))[0] @ command_rad
        leave = min(leave, int(np.argmax(np.abs(angle_rad) > tolerance_rad)) - 1)
        arrive = max(arrive, int(np.flatnonzero(np.abs(angle_rad - distance_rad) > tolerance_rad)[-1]) + 1)
    acceleration = respond(servos.servo, len(command_rad))[1] @ command_rad
    heat = float((acceleration**2).sum() * SAMPLE_S)
    delay_samples = round(servos.delay_s / SAMPLE_S)
    return JudgedCommand(leave - delay_samples, arrive + delay_samples, heat)


def build_step(servo, distance_rad):
    """Return the target of a servo after a step, [n]: it begins to move with the first sample."""
    ramp_s = distance_rad / servo.slew
    return np.minimum(np.arange(0.0, ramp_s + SAMPLE_S, SAMPLE_S) * servo.slew, distance_rad)


def build_jerk_limited(servo, distance_rad, samples, plateau):
    """Return the command of a jerk-limited move over about this time, None if it passes the slew limit."""
    # Of a move by one unit, about one unit of time long: the solver does not work in SI units.
    otg, limits, path = Ruckig(1), InputParameter(1), Trajectory(1)
    limits.current_position, limits.target_position = [0.0], [1.0]
    limits.max_velocity, limits.max_acceleration, limits.max_jerk = [10.0], [8.0 * plateau], [32.0]
    otg.calculate(limits, path)
    unit_s = samples * SAMPLE_S
    times = np.arange(0.0, path.duration + SAMPLE_S / unit_s, SAMPLE_S / unit_s)
    angle, speed, acceleration = np.array([path.at_time(min(t, path.duration)) for t in times])[:, :, 0].T
    omega = 2.0 * np.pi * servo.frequency * unit_s
    command_rad = distance_rad * (angle + 2.0 * servo.damping / omega * speed + acceleration / omega**2)
    return command_rad if np.abs(np.diff(command_rad)).max() <= servo.slew * SAMPLE_S else None


def list_jerk_limited(servos, distance_rad, tolerance_rad):
    """Return dark samples and heat of all jerk-limited moves that the slew limit permits."""
    commands = (
        build_jerk_limited(servos.servo, distance_rad, samples, plateau)
        for samples in range(20, 100, 2)
        for plateau in PLATEAUS
    )
    return [judge_command(servos, each, distance_rad, tolerance_rad) for each in commands if each is not None]


def measure_moves(bench, servos, name):
    """Yield the rows of a move by one pitch. A row is missing where there is no such move."""
    config, servo, way_rad = bench.display.config, servos.servo, bench.settling.pitch_rad
    tolerance_rad = find_tolerance_rad(config)
    step = judge_command(servos, build_step(servo, way_rad), way_rad, tolerance_rad)
    others = list_jerk_limited(servos, way_rad, tolerance_rad)
    step_dark_s = step.arrive * SAMPLE_S + servo.delay
    dark_samples = {
        "early steps": step.dark_samples,
        "ruckig": min((each.dark_samples for each in others if each.heat <= step.heat), default=None),
        "smooth": find_fastest_move(servos, way_rad, tolerance_rad, step.heat).dark_samples,
    }
    yield f"move of one pitch, servo {name}: dark time, steps", step_dark_s * 1e6, "µs"
    for who, samples in dark_samples.items():
        if samples is not None:
            yield (
                f"move of one pitch, servo {name}: dark time at the heat of a step, {who}",
                samples * SAMPLE_S * 1e6,
                "µs",
            )
    cap_heat = config.limits.galvo_acceleration_rms_max_rad_per_s2**2 / TRAIN_RATE_HZ
    for what, samples, heat in (
        (f"move of one pitch, servo {name}: mirror rms over steps", round(step_dark_s / SAMPLE_S), step.heat),
        (f"1 ms pulses at 800/s, servo {name}: mirror rms over the galvo cap", TRAIN_DARK_SAMPLES, cap_heat),
    ):
        smooth, limit = (compute_move(servos, way_rad, tolerance_rad, samples, alone) for alone in (False, True))
        heats = {
            "early steps": step.heat if step.dark_samples <= samples else None,
            "ruckig": min((each.heat for each in others if each.dark_samples <= samples), default=None),
            "smooth": smooth and smooth.heat,
            "limit": limit and limit.heat,
        }
        for who, each_heat in heats.items():
            if each_heat is not None:
                yield f"{what}, {who}", sqrt(each_heat / heat), "×"


def find_tolerance_rad(config):
    """Return the angle tolerance of both mirrors, less a code of rounding, rad."""
    return min(config.tolerance_rad) - config.scanner.rad_per_code


def measure_frame(bench, floor_s, who, dark_us=None, heat=None):
    """Yield the rows of a full frame.

    dark_us: dark times of moves by 1, 2 and more pitches, by default those of the scheduler; heat: of a move, rad²/s³
    """
    config, pitch_rad = bench.display.config, bench.settling.pitch_rad

    def compute_move_us(origin, pixel, _dwell_us):
        if origin is None:
            return bench.settling.lead_in_us
        ways_rad = (bench.x_rad[pixel] - bench.x_rad[origin], bench.y_rad[pixel] - bench.y_rad[origin])
        return dark_us[round(max(map(abs, ways_rad)) / pitch_rad) - 1]

    frame = [np.full(len(bench.layout), FRAME_HEIGHT_M)]
    move_us = bench.compute_move_us if dark_us is None else compute_move_us
    result = bench.plan_order(frame, bench.order_by_scheduler, move_us)
    yield f"full, 50 µm: time over lower bound, {who}", result["total_s"] / floor_s, "×"
    yield f"full, 50 µm: beam-on fraction, {who}", result["light_s"] / result["total_s"], "1"
    if heat is not None:
        cap = config.limits.galvo_acceleration_rms_max_rad_per_s2
        rms = sqrt((result["count"] - 1) * heat / result["total_s"])
        yield f"full, 50 µm: mirror rms over the galvo cap, if one mirror made all moves, {who}", rms / cap, "×"


def measure_trajectories(bench):
    """Yield the rows of all trajectories."""
    config = bench.display.config
    servo, tolerance_rad = build_servo(config.scanner), find_tolerance_rad(config)
    frame = [np.full(len(bench.layout), FRAME_HEIGHT_M)]
    floor_s = bench.plan_order(frame, bench.order_by_scheduler, lambda *_: 0)["full_power_s"]
    ways_rad = [bench.settling.pitch_rad * pitches for pitches in range(1, FRAME_PITCHES_MAX + 1)]
    yield from measure_frame(bench, floor_s, "steps")
    for name, (relative, delay_s) in UNCERTAINTIES.items():
        servos = ServoRange(servo, relative, relative, 0.0, delay_s)
        yield from measure_moves(bench, servos, name)
        steps = [judge_command(servos, build_step(servo, way_rad), way_rad, tolerance_rad) for way_rad in ways_rad]
        early_us = [round(1e6 * SAMPLE_S * step.dark_samples) for step in steps]
        yield from measure_frame(bench, floor_s, f"early steps, servo {name}", early_us, steps[0].heat)
        table = SmoothTable.from_config(config, servos, FRAME_PITCHES_MAX, FRAME_HEAT_RATIO)
        smooth_us = [round(1e6 * move.dark_s) for move in table.moves]
        yield from measure_frame(bench, floor_s, f"smooth, servo {name}", smooth_us, table.moves[0].heat)
