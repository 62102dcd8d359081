"""Beam time and shortest time of moves of a picture, and frames that refresh it while it is held."""

from math import ceil, sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, TactileFrame
from optodrive.device.config import Config
from optodrive.device.gate_timing import build_servo_range
from optodrive.device.pixel_map import load_pixel_map, remove_pixel_map
from optodrive.device.settling_bound import bound_settling_s
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import build_cold_state
from optodrive.planning.batch_limiter import PAUSE_FRACTION_MAX
from optodrive.planning.budget_setup import build_galvo_model
from optodrive.planning.limiter.galvo_load import move_energy, ringing_envelope_factor
from optodrive.planning.scheduler.visiting_path import compute_visiting_order
from optodrive.planning.stimuli.pixel_lattice import Lattice


class GalvoTimeEstimator:
    """Estimates the time over which a picture's moves must be spread, if it is drawn again and again."""

    def __init__(self, config: Config) -> None:
        self._galvo = build_galvo_model(config)
        cap_rad2_per_s4 = config.limits.galvo_acceleration_rms_max_rad_per_s2**2
        # The limiter always counts one more move, of any length.
        self._available_rad2_per_s4 = cap_rad2_per_s4 - move_energy(self._galvo, 1e9) / self._galvo.averaging_s

    def compute_time_s(self, dx_rad: FloatArray, dy_rad: FloatArray, beam_time_s: float) -> float:
        """Return the time of the moves, with room for a last pause, s, or beam_time_s if the moves fit within it.

        dx_rad, dy_rad: [n] moves of the two mirrors; beam_time_s: time of the pulses and of settling
        """
        if self._available_rad2_per_s4 <= 0.0:
            return beam_time_s
        envelope = ringing_envelope_factor(self._galvo, beam_time_s / max(1, len(dx_rad)))
        load_rad2_per_s3 = max(self._sum_energy(dx_rad, envelope), self._sum_energy(dy_rad, envelope))
        time_s = load_rad2_per_s3 / self._available_rad2_per_s4
        return time_s + PAUSE_FRACTION_MAX * self._galvo.averaging_s if time_s > beam_time_s else beam_time_s

    def _sum_energy(self, moves_rad: FloatArray, envelope: float) -> float:
        """Return an upper bound on the integral of a² over moves of one mirror, of which each adds to a ringing one."""
        roots, ringing = np.zeros(len(moves_rad)), 0.0
        for position, move_rad in enumerate(moves_rad.tolist()):
            ringing = sqrt(move_energy(self._galvo, abs(move_rad) + self._galvo.rad_per_code)) + envelope * ringing
            roots[position] = ringing
        return float((roots**2).sum())


REFRESH_HZ = 10.0
"""Largest rate at which a held picture is drawn again, Hz."""

HEIGHT_STEP_RELATIVE = 0.01
"""Relative step to which individual pixel targets are rounded, so that few distinct heights are solved."""

BEAM_TIME_MARGIN = 1.05
"""Factor by which the allotted beam time exceeds the estimate."""


class BeamTimeEstimator:
    """Estimates the beam time of a picture from the cold state: pulses as planned, moves on a short path.

    The moves are spread over as much time as the galvo cap requires.
    """

    def __init__(self, config: Config) -> None:
        self.lattice = Lattice.from_config(config)
        self._scanner, self._servos = config.scanner, build_servo_range(config.scanner)
        self._tolerance_rad, self._pitch_m = min(config.tolerance_rad), config.display.pitch_m
        self._drive = DriveRange.from_config(config)
        known = load_pixel_map(config)
        self._lift = None if known is None else known.displacement_factor
        self._galvo_time = GalvoTimeEstimator(config)
        self._cold_heat = build_cold_state(remove_pixel_map(config), load_parameters(config.pixel_model.parameters))

    def min_pulse_s(self, target_m: float) -> float:
        """Return the shortest pulse from the cold state that reaches a height, s.

        An unreachable height counts as the longest pulse.
        """
        pulse = self._cold_heat.solve_pulse(0, 0.0, target_m, self._drive)
        return self._drive.period_s * (1 if pulse is None else pulse[0])

    def settling_s(self, distance_m: float) -> float:
        """Return the settling time of a move between two absorbers, s."""
        move_rad = distance_m / (2.0 * self._scanner.focal_length_m)
        return bound_settling_s(self._servos, move_rad, move_rad, self._tolerance_rad)

    def beam_time_s(self, target_m: FloatArray) -> float:
        """Return the beam time of a picture with its margin, in whole milliseconds, s.

        target_m: [p]
        """
        driven = np.flatnonzero((target_m > 0) if self._lift is None else (target_m > 0) & (self._lift > 0))
        if not len(driven):
            return 0.0
        heights_m, counts = np.unique(self._nominal_targets_m(target_m, driven), return_counts=True)
        pulses_s = sum(self.min_pulse_s(float(h)) * int(n) for h, n in zip(heights_m, counts, strict=True))
        layout = self.lattice.layout
        x_rad, y_rad = (at_m / (2.0 * self._scanner.focal_length_m) for at_m in (layout.x_m, layout.y_m))
        order = compute_visiting_order(driven, layout.row, layout.column, x_rad, y_rad)
        dx_rad, dy_rad = (np.abs(np.diff(at_rad[order], append=at_rad[order[0]])) for at_rad in (x_rad, y_rad))
        distances_m = 2.0 * self._scanner.focal_length_m * np.maximum(dx_rad, dy_rad)
        # A single pixel still needs a move of at least one pitch.
        distances_unique_m, counts = np.unique(np.maximum(distances_m, self._pitch_m).round(9), return_counts=True)
        moves_s = sum(
            self.settling_s(float(each_m)) * int(n) for each_m, n in zip(distances_unique_m, counts, strict=True)
        )
        time_s = self._galvo_time.compute_time_s(dx_rad, dy_rad, pulses_s + moves_s)
        return ceil(BEAM_TIME_MARGIN * time_s * 1e3) / 1e3

    def _nominal_targets_m(self, target_m: FloatArray, driven: IntArray) -> FloatArray:
        """Return targets of a nominal pixel whose pulses raise the mapped pixels to their own targets, m, [driven].

        Targets are rounded up in steps of HEIGHT_STEP_RELATIVE.
        """
        if self._lift is None:
            return target_m[driven]
        log_targets = np.log(target_m[driven] / self._lift[driven])
        return np.asarray(np.exp(np.ceil(log_targets / HEIGHT_STEP_RELATIVE) * HEIGHT_STEP_RELATIVE), dtype=np.float64)


def hold_picture(
    estimator: BeamTimeEstimator, target_m: FloatArray, seconds: float, name: str, start_s: float = 0.0
) -> list[TactileFrame]:
    """Build frames that hold a picture for at least `seconds` by drawing it again and again.

    target_m: [p]. Each frame lasts as long as the beam needs, the frames abut, and the first starts at start_s.
    """
    frame_s = max(estimator.beam_time_s(target_m), 1.0 / REFRESH_HZ)
    count = max(1, ceil(seconds / frame_s - 1e-9))
    return [TactileFrame(f"{name}-{k}", start_s + k * frame_s, frame_s, target_m) for k in range(count)]


def build_steps(
    estimator: BeamTimeEstimator, pictures: list[FloatArray], step_s: float, name: str
) -> list[TactileFrame]:
    """Build frames that show pictures once each, for step_s or as long as the beam needs.

    pictures: each [p]
    """
    frames: list[TactileFrame] = []
    start_s = 0.0
    for k, target_m in enumerate(pictures):
        frame_s = max(estimator.beam_time_s(target_m), step_s)
        frames.append(TactileFrame(f"{name}-{k}", start_s, frame_s, target_m))
        start_s += frame_s
    return frames


def sequence_end_s(sequence: FrameSequence) -> float:
    """Return the end of the last frame, pulse, or cycle of a height train, s, or 0 for an empty sequence."""
    frame_ends = [frame.show_at_s + frame.duration_s for frame in sequence.frames]
    train_ends = [
        float(train.pulse_starts_s()[-1]) + (train.period_s if isinstance(train, HeightTrain) else train.pulse_width_s)
        for train in sequence.trains
    ]
    return max(frame_ends + train_ends, default=0.0)
