"""Pixel maps: the file, and its effect on planner, limiter and board."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.device.pixel_map import (
    DEAD,
    MEASURED,
    NUMERIC_FIELDS,
    PixelMap,
    build_aim_layout,
    load_pixel_map,
    max_aim_offset_m,
    replace_pixel_map,
    write_pixel_map,
)
from optodrive.link.board_setup import build_board_requirements
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.pipeline import plan_sequence, warm_up
from optodrive.planning.plan_summary import summarize_plan
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.refresh import BeamTimeEstimator
from optodrive.planning.summary_schema import DeadPixelSummary

PLAIN = DISPLAYS["display-16"]
CONFIG, COUNT = PLAIN.config, len(PLAIN.layout)
LOW, HIGH, DEAD_PIXEL = 0, 6, 12


def some_map(offset_m=1e-4):
    random, unknown = np.random.default_rng(2), np.full(COUNT, np.nan)
    gain, state = random.uniform(0.8, 1.2, COUNT), np.full(COUNT, MEASURED)
    gain[LOW], gain[HIGH], state[DEAD_PIXEL] = 0.6, 1.5, DEAD
    x_m, y_m = random.uniform(-offset_m, offset_m, (2, COUNT))
    return PixelMap(gain, np.full(COUNT, 0.01), x_m, y_m, unknown, np.full(COUNT, 1e-6), state, "surroundings")


def write_and_use_map(path, pixel_map=None, config=CONFIG):
    write_pixel_map(path, some_map() if pixel_map is None else pixel_map, config, {"source": "a test"})
    return replace_pixel_map(CONFIG, path)


@pytest.fixture(scope="module")
def display(tmp_path_factory):
    return DisplayModel.from_config(write_and_use_map(tmp_path_factory.mktemp("map") / "pixels.toml"))


def frame_of_all(target_m, count=COUNT):
    return FrameSequence((TactileFrame("all", 0.0, 1.0, np.full(count, target_m)),))


def test_there_and_back(tmp_path):
    pixel_map, again = some_map(), load_pixel_map(write_and_use_map(tmp_path / "pixels.toml"))
    for name in NUMERIC_FIELDS:
        assert getattr(again, name) == pytest.approx(getattr(pixel_map, name), rel=1e-5, nan_ok=True)
    assert again.state.tolist() == pixel_map.state.tolist()
    assert again.displacement_factor[DEAD_PIXEL] == 0.0


def test_a_changed_file_is_read_again(tmp_path):
    config = write_and_use_map(tmp_path / "pixels.toml")
    before = load_pixel_map(config)
    write_and_use_map(tmp_path / "pixels.toml", PixelMap.uniform(COUNT))
    assert load_pixel_map(config).gain.tolist() != before.gain.tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            (b"rows = 4", b"rows = 5"),
            "display.rows: got 5, expected 4, the value of display-16: this is a map of display-16",
        ),
        ((b"missing = []", b"missing = [[0, 0]]"), "display.missing: got '1 places'"),
        ((b"pitch_m = 0.004", b"pitch_m = 0.0036"), "display.pitch_m: got 0.0036"),
        ((b"optodrive-pixels", b"optodrive-field"), "format: got 'optodrive-field'"),
        ((b"version = 1", b"version = 2"), "version: got 2"),
        ((b"gain = 0.6", b"gain = -1.0"), "map.pixels.0.gain: got -1.0"),
        ((b"gain = 0.6", b"gane = 0.6"), "map.pixels.0.gane: got 'gane', expected a known key, nearest is 'gain'"),
        ((b"index = 3,", b"index = 4,"), "one entry per pixel, 0 to 15 in order"),
        ((b'parameters = "surroundings"', b'parameters = "other"'), "model.parameters: got 'other'"),
    ],
)
def test_a_map_that_is_not_of_this_display_is_refused(tmp_path, change, message):
    path = tmp_path / "pixels.toml"
    config = write_and_use_map(path)
    assert change[0] in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(*change))
    with pytest.raises(InputError) as caught:
        DisplayModel.from_config(config)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_map_of_another_display_by_name(tmp_path):
    other = DISPLAYS["display-437"]
    config = write_and_use_map(tmp_path / "p.toml", PixelMap.uniform(len(other.layout)), other.config)
    with pytest.raises(InputError, match="this is a map of display-437"):
        DisplayModel.from_config(config)


def test_nothing_alive_out_of_its_cell_and_no_file(tmp_path):
    path = tmp_path / "pixels.toml"
    with pytest.raises(InputError, match="at least one live pixel"):
        load_pixel_map(write_and_use_map(path, replace(some_map(), state=np.full(COUNT, DEAD))))
    with pytest.raises(InputError, match=r"pixel 0: offset_y_m: got .* the pixel's own cell"):
        load_pixel_map(write_and_use_map(path, PixelMap.uniform(COUNT, 0.0, 1.1 * max_aim_offset_m(CONFIG)[1])))
    with pytest.raises(InputError, match="a readable file"):
        load_pixel_map(replace_pixel_map(CONFIG, tmp_path / "none.toml"))


def test_heights_are_kept_and_heat_is_never_scaled(display):
    plan = plan_sequence(display, frame_of_all(60e-6), *display.build_cold_state())
    nominal = plan_sequence(PLAIN, frame_of_all(60e-6), *PLAIN.build_cold_state())
    assert plan.predicted_m == pytest.approx(np.full(COUNT - 1, 60e-6), rel=1e-3)
    energy_j, nominal_j = (
        dict(zip(each.plan.pixel.tolist(), each.plan.energy_j, strict=True)) for each in (plan, nominal)
    )
    assert DEAD_PIXEL not in energy_j
    assert energy_j[LOW] > 1.3 * nominal_j[LOW]
    assert energy_j[HIGH] < 0.8 * nominal_j[HIGH]
    pulsed = (plan.plan.pixel, plan.plan.start_s, plan.plan.width_s, plan.plan.power_w)
    assert np.array_equal(
        display.build_cold_heat().apply_pulses(*pulsed).absorber_k,
        PLAIN.build_cold_heat().apply_pulses(*pulsed).absorber_k,
    )
    for name in ("r_k_per_w", "c_j_per_k", "epsilon", "tau_g_s"):
        assert np.array_equal(getattr(display.pixels, name), getattr(PLAIN.pixels, name))


def test_the_beam_is_sent_to_the_offset_and_the_board_lets_it(display):
    plan = plan_sequence(display, frame_of_all(60e-6), *display.build_cold_state()).plan
    pixel_map, focal_m = some_map(), CONFIG.scanner.focal_length_m
    aimed_m = PLAIN.layout.x_m + pixel_map.offset_x_m, PLAIN.layout.y_m + pixel_map.offset_y_m
    assert plan.x_rad == pytest.approx(aimed_m[0][plan.pixel] / (2 * focal_m), rel=1e-4)
    assert plan.y_rad == pytest.approx(aimed_m[1][plan.pixel] / (2 * focal_m), rel=1e-4)
    requirements = build_board_requirements(display.config)
    limits = requirements.limits
    x_codes, y_codes = requirements.scale.to_codes(plan.x_rad), requirements.scale.to_codes(plan.y_rad)
    assert limits.x_min <= x_codes.min() <= x_codes.max() <= limits.x_max
    assert limits.y_min <= y_codes.min() <= y_codes.max() <= limits.y_max
    moves = display.scan_head.settling
    for dx_rad, dy_rad, settle_s in zip(np.diff(plan.x_rad), np.diff(plan.y_rad), plan.settling_s[1:], strict=True):
        assert settle_s * 1e6 >= moves.min_settling_us(np.array([dx_rad]), np.array([dy_rad])) - 1


def test_the_dead_are_left_out_and_named(display):
    prepared, feasibility = check_feasibility(display, frame_of_all(60e-6), *display.build_cold_state())
    stats = summarize_plan(prepared, feasibility)
    assert feasibility.fits
    assert stats.dead == DeadPixelSummary(pixels=[DEAD_PIXEL], count=1, message=f"pixel {DEAD_PIXEL} is dead: omitted")
    alone = np.zeros(COUNT)
    alone[DEAD_PIXEL] = 5e-3  # unreachable for every pixel
    nothing, _ = check_feasibility(
        display, FrameSequence((TactileFrame("dead", 0.0, 1.0, alone),)), *display.build_cold_state()
    )
    assert len(nothing.plan) == 0
    assert summarize_plan(nothing).dead.count == 1
    alive = np.where(np.arange(COUNT) == DEAD_PIXEL, 0.0, 60e-6)
    fine, _ = check_feasibility(
        display, FrameSequence((TactileFrame("alive", 0.0, 1.0, alive),)), *display.build_cold_state()
    )
    assert summarize_plan(fine).dead == DeadPixelSummary(pixels=[], count=0, message=None)


@pytest.mark.parametrize(
    "train",
    [
        PulseTrain(DEAD_PIXEL, 0.0, 0.1, 0.01, 0.01, 1.0),
        HeightTrain(DEAD_PIXEL, 0.0, 1.0, 0.1, 50e-6),
    ],
)
def test_a_train_on_a_dead_pixel_is_refused(display, train):
    living = PulseTrain(LOW, 0.2, 0.1, 0.01, 0.01, 1.0)
    with pytest.raises(InputError, match=r"trains\[1\]\.pixel: got 12, expected a live pixel") as caught:
        check_feasibility(display, FrameSequence((), (living, train)), *display.build_cold_state())
    assert caught.value.code == "dead_pixel"


def test_reach_follows_the_gain(display):
    too_much_m = 1.01 * float(display.max_displacement_m[LOW])
    assert too_much_m < PLAIN.max_displacement_m[LOW]
    target_m = np.zeros(COUNT)
    target_m[LOW] = too_much_m
    with pytest.raises(InputError, match="target_um of pixel 0"):
        plan_sequence(display, FrameSequence((TactileFrame("high", 0.0, 1.0, target_m),)), *display.build_cold_state())


def test_pictures_are_given_the_time_that_low_pixels_need(display):
    target_m = np.zeros(COUNT)
    target_m[[LOW, 1, 2, 3]] = 200e-6
    plain, own = BeamTimeEstimator(CONFIG), BeamTimeEstimator(display.config)
    assert own.beam_time_s(target_m) > plain.beam_time_s(target_m)
    dead = np.where(np.arange(COUNT) == DEAD_PIXEL, 1e-4, 0.0)
    assert own.beam_time_s(dead) == 0.0
    assert len(Lattice.from_config(display.config).layout) == COUNT


def test_all_is_warmed_up_where_the_first_pixel_is_dead(tmp_path):
    state = np.full(COUNT, MEASURED)
    state[0] = DEAD
    warm_up(DisplayModel.from_config(write_and_use_map(tmp_path / "pixels.toml", replace(some_map(), state=state))))


def test_without_a_map_nothing_moves():
    assert np.array_equal(build_aim_layout(CONFIG).x_m, PLAIN.layout.x_m)
    assert not PLAIN.dead.any()
