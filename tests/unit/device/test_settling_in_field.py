"""Settling times in a calibrated field, where moves have any distance: every move gets the time that it needs."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hidden_field import CONFIG, LAYOUT
from optodrive.device.config import Config, PixelLayout
from optodrive.device.gate_timing import build_servo_range, settling_s
from optodrive.device.scan_field import IdealField, max_neighbour_step_rad, tolerance_ratio
from optodrive.device.settling import LONG_DWELL_SHARE, SettlingTable


class Askew:
    """An ideal lens with a magnified, rotated and distorted image."""

    def __init__(self, magnification=1.02, turn_rad=0.02, bend_per_m=0.3):
        self.magnification, self.turn_rad, self.bend_per_m = magnification, turn_rad, bend_per_m

    def angles_rad(self, x_m, y_m):
        distorted = 1.0 + self.bend_per_m * x_m
        x_m, y_m = distorted * x_m - self.turn_rad * y_m, distorted * y_m + self.turn_rad * x_m
        return IdealField(CONFIG.scanner.focal_length_m * self.magnification).angles_rad(x_m, y_m)


def servo(**scanner):
    table = CONFIG.model_dump()
    table["scanner"] |= scanner
    return Config.model_validate(table)


CASES = {
    "shipped": CONFIG,
    "ringing": servo(damping=0.3, bandwidth_hz=400.0, slew_rad_per_s=300.0),
    "overshooting": servo(damping=0.5, bandwidth_hz=400.0, slew_rad_per_s=300.0),
    "resonant": servo(damping=0.3, bandwidth_hz=400.0, slew_rad_per_s=30.0),  # a ramp may damp the ringing or excite it
}


@cache
def build_moves(name):
    return SettlingTable.from_config(CASES[name], Askew())


def required_us(config, axis, distance_rad, place=(0.0, 0.0, 0.0, 0.0)):
    """Return the settling time that a move after a long dwell needs in this field, µs.

    place: of the servo within the declared uncertainty
    """
    tolerance_rad = tolerance_ratio(Askew(), LAYOUT, config) * config.tolerance_rad[axis]
    tolerance_left_rad = (1.0 - LONG_DWELL_SHARE) * (
        tolerance_rad - 0.5 * config.scanner.rad_per_code
    ) - config.scanner.rad_per_code
    return 1e6 * settling_s(build_servo_range(config.scanner).servo_at(*place), distance_rad, tolerance_left_rad)


@settings(max_examples=3 * settings.default.max_examples)
@given(st.sampled_from(sorted(CASES)), st.integers(0, 1), st.floats(1e-3, 19.9), st.tuples(*[st.floats(-1, 1)] * 4))
def test_no_move_is_given_less_than_it_needs(name, axis, pitches, place):
    config, moves = CASES[name], build_moves(name)
    distance_rad = pitches * moves.pitch_rad
    move = (distance_rad, 0.0) if axis == 0 else (0.0, distance_rad)
    assert moves.settling_us(*move, moves.long_dwell_us) >= required_us(config, axis, distance_rad, place)


def test_times_of_whole_pitches_alone_would_be_too_short():
    """Mutant: the time of a whole pitch for all shorter moves."""
    config, moves = CASES["resonant"], build_moves("resonant")
    short = 0
    for pitches in np.linspace(0.05, 19.95, 400):
        whole_us = required_us(config, 0, np.ceil(pitches) * moves.pitch_rad)
        short += whole_us < required_us(config, 0, pitches * moves.pitch_rad)
    assert short


def test_every_move_between_pixels_is_in_the_tables():
    for field in (Askew(), Askew(1.03, -0.02, -0.3)):
        moves = SettlingTable.from_config(CONFIG, field)
        x_rad, y_rad = field.angles_rad(LAYOUT.x_m, LAYOUT.y_m)
        longest_us = moves.settling_us(float(np.ptp(x_rad)), float(np.ptp(y_rad)))
        assert longest_us <= moves.lead_in_us
        for at in (0, 10, len(LAYOUT) - 1):
            assert moves.settling_us(x_rad[at], y_rad[at]) <= moves.lead_in_us


def test_neighbours_are_one_pitch_apart_whatever_the_field():
    moves = build_moves("shipped")
    x_rad, y_rad = Askew().angles_rad(LAYOUT.x_m, LAYOUT.y_m)
    one_us = moves.settling_us(moves.pitch_rad, moves.pitch_rad, moves.long_dwell_us)
    for one in range(0, len(LAYOUT), 7):
        beside = (np.abs(LAYOUT.row - LAYOUT.row[one]) <= 1) & (np.abs(LAYOUT.column - LAYOUT.column[one]) <= 1)
        for other in np.flatnonzero(beside):
            if other != one:
                assert (
                    moves.settling_us(x_rad[other] - x_rad[one], y_rad[other] - y_rad[one], moves.long_dwell_us)
                    <= one_us
                )


def test_room_for_the_focus_in_a_field_askew():
    ideal = IdealField(CONFIG.scanner.focal_length_m)
    assert tolerance_ratio(ideal, LAYOUT, CONFIG) == pytest.approx(1.0, abs=1e-9)
    assert 0.9 < tolerance_ratio(Askew(), LAYOUT, CONFIG) < 0.98


def test_a_single_pixel_off_the_middle_has_a_lead():
    """Its position is not the centre of the mirrors' range."""
    one = replace_display(rows=1, columns=1, missing=[])
    assert SettlingTable.from_config(one, Shifted()).lead_in_us > 200
    assert (
        max_neighbour_step_rad(PixelLayout(*(np.zeros(1),) * 2, *(np.zeros(1, dtype=int),) * 2), *(np.zeros(1),) * 2)
        == 0
    )


class Shifted:
    def angles_rad(self, x_m, y_m):
        return IdealField(CONFIG.scanner.focal_length_m).angles_rad(x_m + 1e-3, y_m)


def replace_display(**display):
    table = CONFIG.model_dump()
    table["display"] |= display
    return Config.model_validate(table)
