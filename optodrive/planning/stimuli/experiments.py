"""The paper's six perceptual experiments (Text S5) as pulse trains, a comparison of two places, and bring-up waveforms.

docs/reference/patterns.md lists what the paper leaves open. Directions are as seen from above: right is +x, up is +y.
`centre` None is the display's middle pixel. `where` names the caller in errors. Every function raises InputError
(does_not_fit) if the display lacks a pixel at a required place. A comparison shows two places one after the other.
Waveforms for an oscilloscope on the converter's outputs, for the bring-up of a board, are weak pulses in turn.
"""

from collections.abc import Iterable, Sequence
from math import ceil

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain
from optodrive.device.config import Config, PixelLayout
from optodrive.device.gate_timing import build_servo_range
from optodrive.device.sensitivity_map import replace_sensitivity_map
from optodrive.device.settling_bound import bound_settling_s
from optodrive.planning.stimuli.intensity import IntensityModel
from optodrive.planning.stimuli.pixel_lattice import Lattice

DIRECTIONS = {"left": (0, -1), "right": (0, 1), "up": (1, 0), "down": (-1, 0)}
"""Step (rows up, columns right) of each direction."""
CLOCKWISE = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0))
"""Eight places around a centre as (rows up, columns right), clockwise from the bottom left."""

SPEEDS_S = {"16": 0.200, "32": 0.100, "64": 0.050}
"""Time per pixel by speed in mm/s, s."""

PULSE_AND_GAP_S = {"slow": 0.035, "fast": 0.010}
"""Pulse width, and equal gap, of the two kinds of stimulus in experiment 5, s."""

DETECTION_PITCHES = 3
"""Distance of the two places of a detection from the centre."""

FINGERS_UP_M = {2: 0.0, 3: 7.2e-3, 4: 3.6e-3, 5: -10.8e-3}
"""Position of the fingertips of a right hand relative to the index finger, m; the paper gives no positions."""

FINGER_SPACING_M = 18e-3
"""Lateral distance between neighbouring fingers, m."""


def build_slot_train(
    pixel: int, start_s: float, slot_s: float, width_s: float, gap_s: float, power_w: float
) -> PulseTrain:
    """Build a pixel's cyclic stimulation for a time slot, without a pulse that would end after the slot."""
    period_s = width_s + gap_s
    whole = max(1, int((slot_s + gap_s) / period_s + 1e-9))
    return PulseTrain(pixel, start_s, min(slot_s, whole * period_s), width_s, gap_s, power_w)


def build_linear_motion(config: Config, where: str, direction: str, centre: int | None) -> FrameSequence:
    """Build experiment 1: three pixels in a row, 300 ms each at 20/60 ms, repeated after a pause of 500 ms."""
    up, right = DIRECTIONS[direction]
    row = Lattice.from_config(config).pixels_around(
        centre, [(k * up, k * right) for k in (-1, 0, 1)], where, "a neighbour on either side"
    )
    starts_s = [cycle_s + 0.3 * k for cycle_s in (0.0, 1.4) for k in range(3)]
    power_w = config.laser.max_power_w
    return _build_sequence(
        build_slot_train(p, at_s, 0.3, 0.020, 0.060, power_w) for p, at_s in zip(row * 2, starts_s, strict=True)
    )


def build_rotation(config: Config, where: str, direction: str, speed: str, centre: int | None) -> FrameSequence:
    """Build experiment 2: eight pixels around a centre from the bottom left, one turn, at 25/71 ms."""
    places = CLOCKWISE if direction == "cw" else (CLOCKWISE[0], *reversed(CLOCKWISE[1:]))
    ring = Lattice.from_config(config).pixels_around(centre, places, where, "the eight pixels around it")
    slot_s, power_w = SPEEDS_S[speed], config.laser.max_power_w
    return _build_sequence(
        build_slot_train(pixel, k * slot_s, slot_s, 0.025, 0.071, power_w) for k, pixel in enumerate(ring)
    )


def build_localisation(config: Config, where: str, target: int, centre: int | None) -> FrameSequence:
    """Build experiment 3: a centre reference, then one of 3 × 3 places (target 1 is the top left).

    Each is shown for 500 ms at 25/25 ms, with a pause of 750 ms between.
    """
    places = [(1 - k // 3, k % 3 - 1) for k in range(9)]
    grid = Lattice.from_config(config).pixels_around(centre, places, where, "the eight pixels around it")
    power_w = config.laser.max_power_w
    return _build_sequence(
        build_slot_train(pixel, at_s, 0.5, 0.025, 0.025, power_w)
        for pixel, at_s in ((grid[4], 0.0), (grid[target - 1], 1.25))
    )


def build_intensity(config: Config, where: str, level: int, centre: int | None) -> FrameSequence:
    """Build experiment 4: one pixel for 1 s at 25/25 ms, level 1…9 from 0.5 to 2.5 W, limited to the laser's power."""
    (pixel,) = Lattice.from_config(config).pixels_around(centre, [(0, 0)], where, "a place for the stimulus")
    power_w = min(0.5 + 0.25 * (level - 1), config.laser.max_power_w)
    return _build_sequence([build_slot_train(pixel, 0.0, 1.0, 0.025, 0.025, power_w)])


def build_detection(config: Config, where: str, side: str, power_w: float, centre: int | None) -> FrameSequence:
    """Build a stimulus for detection: the pixel three pitches left or right of a centre, 500 ms at 25/25 ms."""
    column = -DETECTION_PITCHES if side == "left" else DETECTION_PITCHES
    (pixel,) = Lattice.from_config(config).pixels_around(
        centre, [(0, column)], where, "a pixel three pitches beside it"
    )
    return _build_sequence([build_slot_train(pixel, 0.0, 0.5, 0.025, 0.025, min(power_w, config.laser.max_power_w))])


def build_temporal_pattern(
    config: Config, where: str, oddball: int, kind: str, pause_s: float, centre: int | None
) -> FrameSequence:
    """Build experiment 5: three stimuli of 400 ms on one pixel, one of them (oddball, 1…3) of `kind`, slow or fast."""
    (pixel,) = Lattice.from_config(config).pixels_around(centre, [(0, 0)], where, "a place for the stimulus")
    other = "fast" if kind == "slow" else "slow"
    widths_s = [PULSE_AND_GAP_S[kind if k == oddball else other] for k in (1, 2, 3)]
    return _build_sequence(
        build_slot_train(pixel, k * (0.4 + pause_s), 0.4, width_s, width_s, config.laser.max_power_w)
        for k, width_s in enumerate(widths_s)
    )


def build_two_fingers(config: Config, where: str, digits: str, centre: int | None) -> FrameSequence:
    """Build experiment 6: squares of four pixels under two fingers, the fingers alternating.

    40 pulses of 15 ms in five rounds. The paper's 600 ms leave the mirrors of one stage no time: here they have time to
    settle. With several stages, one beam moves while another draws.
    """
    pitch_m = config.display.pitch_m
    pair = [compute_finger_places(int(digit), pitch_m) for digit in digits.split("-")]
    turns = [place for both in zip(*pair, strict=True) for place in both]
    requirement = "space for fingertips that spread over 58 × 22 mm around it"
    lattice = Lattice.from_config(config)
    pixels = lattice.pixels_around(centre, turns, where, requirement)
    move_s = _longest_settling_s(config, lattice.layout, [*pixels, pixels[0]]) if len(config.stages) < 2 else 0.0
    step_s = 0.015 + move_s
    width_s, period_s, rounds = 0.015, step_s * len(pixels), 5
    return _build_sequence(
        PulseTrain(
            pixel=pixel,
            start_s=k * step_s,
            duration_s=(rounds - 1) * period_s + width_s,
            pulse_width_s=width_s,
            gap_s=period_s - width_s,
            power_w=config.laser.max_power_w,
        )
        for k, pixel in enumerate(pixels)
    )


def _longest_settling_s(config: Config, layout: PixelLayout, path: Sequence[int]) -> float:
    """Return the longest settling time of the moves along a path of pixels, in whole microseconds, s."""
    order = list(path)
    moves_m = np.maximum(*(np.abs(np.diff(at_m[order])) for at_m in (layout.x_m, layout.y_m)))
    scanner = config.scanner
    move_rad = float(moves_m.max()) / (2.0 * scanner.focal_length_m)
    longest_s = bound_settling_s(build_servo_range(scanner), move_rad, move_rad, min(config.tolerance_rad))
    return ceil(1e6 * longest_s) / 1e6


def compute_finger_places(digit: int, pitch_m: float) -> list[tuple[int, int]]:
    """Return four places under a finger as (rows up, columns right) from the hand's centre, clockwise from top left."""
    right = round(FINGER_SPACING_M / pitch_m * (digit - 3.5) - 0.5)
    up = round(FINGERS_UP_M[digit] / pitch_m)
    return [(up + 1, right), (up + 1, right + 1), (up, right + 1), (up, right)]


def _build_sequence(trains: Iterable[PulseTrain]) -> FrameSequence:
    return FrameSequence(trains=tuple(trains))


DURATION_S, PAUSE_S, PERIOD_S = 0.4, 0.4, 0.04


def build_comparison(
    config: Config,
    where: str,
    first: int | None,
    second: int | None,
    first_intensity: float,
    second_intensity: float,
) -> FrameSequence:
    """Build two vibrations of 0.4 s at 25 Hz, 0.4 s apart, by default both in the middle of the display.

    Intensities are those of a person of sensitivity 1 everywhere, because a comparison measures the sensitivity. Raises
    InputError (target_unreachable).
    """
    (middle,) = Lattice.from_config(config).pixels_around(None, [(0, 0)], where, "a place for the stimulus")
    model = IntensityModel(replace_sensitivity_map(config, None))
    trains = []
    for number, (pixel, name, intensity) in enumerate(
        ((first, "first", first_intensity), (second, "second", second_intensity))
    ):
        place = middle if pixel is None else pixel
        target_m = model.solve_train_m(place, PERIOD_S, DURATION_S, intensity, f"{where}: {name}_intensity")
        trains.append(HeightTrain(place, number * (DURATION_S + PAUSE_S), DURATION_S, PERIOD_S, target_m))
    return FrameSequence(trains=tuple(trains))


WAVEFORMS = ("steps-x", "steps-y", "square", "ramp-x", "ramp-y")
PULSE_S = 1e-3


def build_scope_waveform(
    config: Config, where: str, waveform: str, dwell_s: float, power_w: float, seconds: float
) -> FrameSequence:
    """Build a waveform: one pulse of PULSE_S per place, dwell_s apart, for `seconds`.

    The mirrors leave a place when its pulse ends, so the outputs step every dwell_s. Raises InputError (does_not_fit)
    for a display with a single pixel along the waveform.
    """
    places = _list_places(Lattice.from_config(config), waveform)
    if len(places) < 2:
        raise InputError(
            f"{where}: waveform", waveform, f"a display with several pixels along it, not {config.name}", "does_not_fit"
        )
    width_s = max(1, round(PULSE_S * config.laser.pwm_hz)) / config.laser.pwm_hz
    period_s = len(places) * dwell_s
    duration_s = max(1, round(seconds / period_s)) * period_s
    power_w = min(power_w, config.laser.max_power_w)
    return FrameSequence(
        (),
        tuple(
            PulseTrain(pixel, round(k * dwell_s, 6), duration_s, width_s, period_s - width_s, power_w)
            for k, pixel in enumerate(places)
        ),
    )


def _list_places(lattice: Lattice, waveform: str) -> list[int]:
    """Return the pixels of a waveform in the order of the visit, without repetitions."""
    layout, middle = lattice.layout, lattice.middle_pixel()
    row = [int(pixel) for pixel in lattice.index[layout.row[middle]] if pixel >= 0]
    column = [int(pixel) for pixel in lattice.index[:, layout.column[middle]] if pixel >= 0]
    match waveform:
        case "ramp-x":
            return row
        case "ramp-y":
            return column
        case "steps-x":
            return list(dict.fromkeys((row[0], row[-1])))
        case "steps-y":
            return list(dict.fromkeys((column[0], column[-1])))
    diagonal_m = {  # distance along the diagonals; the outermost pixels are the corners of the square
        signs: signs[0] * layout.x_m + signs[1] * layout.y_m for signs in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    }
    return list(dict.fromkeys(int(distance_m.argmax()) for distance_m in diagonal_m.values()))
