"""Planning with a calibrated field of a hidden geometry."""

import numpy as np
import pytest

from hidden_field import CONFIG, LAYOUT, aimed_by, field_file
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import load_config, shipped_path
from optodrive.device.field_loader import field_of, moves_of
from optodrive.device.scan_field import IdealField
from optodrive.link.protocol.quantisation import decode, quantise
from optodrive.link.session.board_requirements import Requirements
from optodrive.planning.budget_setup import mirrors_of
from optodrive.planning.pipeline import Display, prepare


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Seed to truth and configuration."""
    folder = tmp_path_factory.mktemp("fields")
    return {seed: field_file(folder / f"field-{seed}.toml", seed) for seed in (0, 1, 2)}


def landed_m(truth, config):
    """Where the light of a full frame really falls, by the very bytes; and the pixel of each pulse."""
    display, scale = Display.of(config), Requirements.of(config).scale
    full = FrameSequence((TactileFrame("full", 0.0, 10.0, np.full(len(LAYOUT), 10e-6)),))
    plan = prepare(display, full, *display.at_rest()).plan
    points = quantise(plan, scale)
    pulses = decode(points.payload(), scale)
    codes = (np.rint(angle_rad / scale.rad_per_code) + 32768 for angle_rad in (pulses.x_rad, pulses.y_rad))
    return np.array(truth.position_m(*codes)), plan.pixel[points.row[pulses.index]]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_planned_pulse_lands_within_30_um_of_its_pixel_and_uncorrected_ones_miss(made, seed):
    truth, config = made[seed]
    for aimed, misses in ((CONFIG, True), (config, False)):
        at_m, pixel = landed_m(truth, aimed)
        off_m = np.hypot(at_m[0] - LAYOUT.x_m[pixel], at_m[1] - LAYOUT.y_m[pixel])
        assert set(pixel.tolist()) == set(range(len(LAYOUT)))
        assert (off_m.max() > 0.5e-3) if misses else (off_m.max() <= 30e-6)


def test_planner_limiter_and_board_see_the_same(made):
    _, config = made[0]
    display, requirements = Display.of(config), Requirements.of(config)
    assert mirrors_of(config).lead_s == display.machine.moves.lead_us * 1e-6
    x_code, y_code = (requirements.scale.codes(a) for a in display.machine.field.angles_rad(LAYOUT.x_m, LAYOUT.y_m))
    limits = requirements.limits()
    assert limits.x_min <= x_code.min() <= limits.x_min + 65
    assert limits.y_max - 65 <= y_code.max() <= limits.y_max


def test_the_board_s_own_time_of_a_move_never_passes_the_plan_s(made):
    for _, config in made.values():
        display, requirements = Display.of(config), Requirements.of(config)
        moves, limits = display.machine.moves, requirements.limits()
        angles_rad = display.machine.field.angles_rad(LAYOUT.x_m, LAYOUT.y_m)
        codes = [requirements.scale.codes(angle_rad) for angle_rad in angles_rad]
        for one, other in np.random.default_rng(0).integers(len(LAYOUT), size=(500, 2)).tolist():
            far = max(abs(int(axis[one] - axis[other])) for axis in codes)
            own_us = limits.settle_us - (-far * limits.settle_ns_per_code // 1000) if far else 0
            dx_rad, dy_rad = (axis[one] - axis[other] for axis in angles_rad)
            assert own_us <= moves.time_us(dx_rad, dy_rad, moves.calm_us)


def test_without_a_field_the_lens_is_ideal():
    assert field_of(CONFIG) == IdealField(CONFIG.scanner.focal_length_m)


def test_a_field_is_looked_for_beside_the_configuration(tmp_path):
    field_file(tmp_path / "field.toml", side=5)
    text = shipped_path("display-437.toml").read_text()
    own = tmp_path / "own.toml"
    own.write_text(text.replace("[scanner]\n", '[scanner]\nfield = "field.toml"\n'))
    assert load_config(own).scanner.field == str(tmp_path / "field.toml")
    moves_of(load_config(own))


def test_a_field_of_another_scanner_is_refused(tmp_path):
    field_file(tmp_path / "field.toml", side=5)
    with pytest.raises(InputError, match=r"scanner\.range_rad: got 0\.2, expected 0\.1745, what .*field\.toml"):
        field_of(aimed_by(tmp_path / "field.toml", range_rad=0.2))
    with pytest.raises(InputError, match=r"scanner\.focal_length_m: got 0\.25, expected 0\.22"):
        field_of(aimed_by(tmp_path / "field.toml", focal_length_m=0.25))


def test_pixels_beyond_the_field_or_the_converter_are_refused_by_name(tmp_path):
    field_file(tmp_path / "field.toml", side=5)
    large = load_config("display-1511")
    with pytest.raises(InputError, match=r"pixel 0 at -.* mm: got .*codes|reaches"):
        field_of(aimed_by(tmp_path / "field.toml", large))


def test_a_field_less_sure_than_the_aim_error_is_refused(tmp_path):
    field_file(tmp_path / "field.toml", side=3)
    with pytest.raises(InputError, match=r"scanner\.aim_error_m: got 1e-05, expected at least"):
        field_of(aimed_by(tmp_path / "field.toml", aim_error_m=1e-5))
