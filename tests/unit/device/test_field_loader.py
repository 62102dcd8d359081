"""Planning with the calibrated field of a hidden geometry."""

import numpy as np
import pytest

from displays import DISPLAYS
from hidden_field import CONFIG, LAYOUT, calibrate_hidden_field, config_with_field
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import Config
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.device.field_loader import build_settling_table, load_scan_field
from optodrive.device.scan_field import IdealField
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import decode, quantise
from optodrive.planning.budget_setup import build_galvo_model
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """Ground truth and configuration by seed."""
    folder = tmp_path_factory.mktemp("fields")
    return {seed: calibrate_hidden_field(folder / f"field-{seed}.toml", seed) for seed in (0, 1, 2)}


def compute_landing_m(truth, config):
    """Return the true positions of a full frame's light, from the bytes on the wire, and the pixel of each pulse."""
    display, scale = DisplayModel.from_config(config), build_board_requirements(config).scale
    full = FrameSequence((TactileFrame("full", 0.0, 10.0, np.full(len(LAYOUT), 10e-6)),))
    plan = plan_sequence(display, full, *display.build_cold_state()).plan
    points = quantise(plan, scale)
    pulses = decode(points.encode_payload(), scale)
    codes = (np.rint(angle_rad / scale.rad_per_code) + 32768 for angle_rad in (pulses.x_rad, pulses.y_rad))
    return np.array(truth.position_m(*codes)), plan.pixel[points.row[pulses.index]]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_planned_pulse_lands_within_30_um_of_its_pixel_and_uncorrected_ones_miss(calibrated, seed):
    truth, config = calibrated[seed]
    for aimed, misses in ((CONFIG, True), (config, False)):
        at_m, pixel = compute_landing_m(truth, aimed)
        error_m = np.hypot(at_m[0] - LAYOUT.x_m[pixel], at_m[1] - LAYOUT.y_m[pixel])
        assert set(pixel.tolist()) == set(range(len(LAYOUT)))
        assert (error_m.max() > 0.5e-3) if misses else (error_m.max() <= 30e-6)


def test_planner_limiter_and_board_see_the_same(calibrated):
    _, config = calibrated[0]
    display, requirements = DisplayModel.from_config(config), build_board_requirements(config)
    assert build_galvo_model(config).lead_in_s == display.scan_head.settling.lead_in_us * 1e-6
    x_code, y_code = (
        requirements.scale.to_codes(a) for a in display.scan_head.field.angles_rad(LAYOUT.x_m, LAYOUT.y_m)
    )
    limits = requirements.limits
    assert limits.x_min <= x_code.min() <= limits.x_min + 65
    assert limits.y_max - 65 <= y_code.max() <= limits.y_max


def test_the_board_s_own_time_of_a_move_never_passes_the_plan_s(calibrated):
    for _, config in calibrated.values():
        display, requirements = DisplayModel.from_config(config), build_board_requirements(config)
        moves, limits = display.scan_head.settling, requirements.limits
        angles_rad = display.scan_head.field.angles_rad(LAYOUT.x_m, LAYOUT.y_m)
        codes = [requirements.scale.to_codes(angle_rad) for angle_rad in angles_rad]
        for one, other in np.random.default_rng(0).integers(len(LAYOUT), size=(500, 2)).tolist():
            far = max(abs(int(axis[one] - axis[other])) for axis in codes)
            own_us = limits.settle_us - (-far * limits.settle_ns_per_code // 1000) if far else 0
            dx_rad, dy_rad = (axis[one] - axis[other] for axis in angles_rad)
            assert own_us <= moves.settling_us(dx_rad, dy_rad, moves.long_dwell_us)


def test_without_a_field_the_lens_is_ideal():
    assert load_scan_field(CONFIG) == IdealField(CONFIG.scanner.focal_length_m)


def test_a_field_is_looked_for_beside_the_configuration(tmp_path):
    calibrate_hidden_field(tmp_path / "field.toml", side=5)
    text = locate_shipped("display-437.toml").read_text()
    own = tmp_path / "own.toml"
    own.write_text(text.replace("[scanner]\n", '[scanner]\nfield = "field.toml"\n'))
    assert load_config(own).scanner.field == str(tmp_path / "field.toml")
    build_settling_table(load_config(own))


def test_a_field_of_another_scanner_is_refused(tmp_path):
    calibrate_hidden_field(tmp_path / "field.toml", side=5)
    with pytest.raises(
        InputError,
        match=r"scanner\.range_rad: got 0\.2, expected 0\.1745, the value that .*field\.toml, a field of "
        "display-437 was made with; this display is display-437",
    ):
        load_scan_field(config_with_field(tmp_path / "field.toml", range_rad=0.2))
    with pytest.raises(InputError, match=r"scanner\.focal_length_m: got 0\.25, expected 0\.22"):
        load_scan_field(config_with_field(tmp_path / "field.toml", focal_length_m=0.25))


def test_pixels_beyond_the_field_or_the_converter_are_refused_by_name(tmp_path):
    calibrate_hidden_field(tmp_path / "field.toml", side=5)
    large = load_config("display-1511")
    with pytest.raises(
        InputError, match=r"pixel 0 of display-1511 at -.* mm: got .*(codes .* outside its extent|converter's range)"
    ) as caught:
        load_scan_field(config_with_field(tmp_path / "field.toml", large))
    assert str(caught.value).endswith(
        f"every pixel of display-1511 within {tmp_path}/field.toml, a field of display-437"
    )


def test_a_field_without_the_name_of_a_display_is_read(tmp_path):
    path = tmp_path / "field.toml"
    calibrate_hidden_field(path, side=5)
    path.write_text(path.read_text().replace('display = "display-437"\n', ""))
    with pytest.raises(InputError, match="a field of an unnamed display"):
        load_scan_field(config_with_field(path, range_rad=0.2))


def test_a_field_less_sure_than_the_aim_error_is_refused(tmp_path):
    calibrate_hidden_field(tmp_path / "field.toml", side=3)
    with pytest.raises(InputError, match=r"scanner\.aim_error_m: got 1e-05, expected at least"):
        load_scan_field(config_with_field(tmp_path / "field.toml", aim_error_m=1e-5))


@pytest.mark.parametrize(("key", "value"), [("slew_rad_per_s", 1.0), ("bandwidth_hz", 100.0)])
def test_a_servo_too_slow_for_a_point_of_the_wire_is_refused(key, value):
    table = DISPLAYS["display-1511"].config.model_dump()
    table["scanner"] |= {"damping": 0.3, "delay_s": 0.01, "aim_error_m": 4.9e-4, key: value}
    with pytest.raises(InputError, match=rf"scanner\.{key}: got {value}, expected a servo that settles within 60 ms"):
        build_settling_table(Config.model_validate(table))
