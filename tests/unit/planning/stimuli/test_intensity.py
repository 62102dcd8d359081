"""Frames and trains by intensity: the planned pulses, felt by an independent statement of the channel model."""

from dataclasses import replace

import numpy as np
import pytest

from executed_lines import count_lines
from felt_intensity import STEP_S, feel
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import HeightTrain
from optodrive.device.config_file import load_config
from optodrive.device.pixel_map import PixelMap, replace_pixel_map, write_pixel_map
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.stimuli.intensity import TRAIN_TABLES_MAX
from optodrive.planning.stimuli.sequence_file import parse_sequence, sequence_to_json

CONFIG = load_config("display-437")
TOLERANCE = 0.02
FRAME = {"show_at_s": 0.0, "duration_s": 2.0}
TRAIN = {"pixel": 200, "start_s": 0.0, "duration_s": 1.0, "period_s": 0.04}


def feel_plan(config, body):
    """Return the intensity that each pixel of a sequence gets by its planned pulses, on a cold display."""
    display = DisplayModel.from_config(config)
    planned, _ = check_feasibility(display, parse_sequence(body, config, "f"), *display.build_cold_state())
    plan = planned.plan
    felt = {}
    for pixel in sorted(set(plan.pixel.tolist())):
        rows = plan.pixel == pixel
        pulses = np.column_stack([each[rows] for each in (plan.start_s, plan.width_s, plan.power_w, plan.pixel)])
        pulses[:, 0] -= pulses[0, 0]
        pulses = pulses[pulses[:, 0] < 1.0 - 1e-9]
        t_s = np.arange(0.0, pulses[-1, 0] + pulses[-1, 1] + 0.1, STEP_S)
        felt[pixel] = feel(display.build_cold_heat().simulate_displacement_m(pulses, pixel, t_s))
    return felt


def refusal(body):
    with pytest.raises(InputError) as caught:
        parse_sequence(body, CONFIG, "f")
    assert "\n" not in str(caught.value)
    return caught.value.code, str(caught.value)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A display whose pixels have gains from 0.6 to 1.5."""
    count = len(DisplayModel.from_config(CONFIG).layout)
    gain = np.random.default_rng(4).uniform(0.6, 1.5, count)
    path = tmp_path_factory.mktemp("map") / "pixels.toml"
    pixel_map = replace(PixelMap.uniform(count), gain=gain, model=CONFIG.pixel_model.parameters)
    write_pixel_map(path, pixel_map, CONFIG, {})
    return replace_pixel_map(CONFIG, path)


@pytest.mark.parametrize("map_name", ["nominal", "mapped"])
def test_planned_pulses_of_a_frame_have_its_intensities(map_name, mapped):
    requested = {3: 0.05, 200: 1.0, 217: 4.0, 300: 9.0, 436: 14.0}
    frame = FRAME | {"intensity": {str(pixel): value for pixel, value in requested.items()}}
    felt = feel_plan(mapped if map_name == "mapped" else CONFIG, {"frames": [frame]})
    assert felt.keys() == requested.keys()
    for pixel, value in requested.items():
        assert felt[pixel] == pytest.approx(value, rel=TOLERANCE, abs=0.02), pixel


@pytest.mark.parametrize("map_name", ["nominal", "mapped"])
@pytest.mark.parametrize(
    ("period_s", "duration_s", "intensity"),
    [(0.04, 1.0, 8.0), (0.04, 0.3, 3.0), (0.1, 1.0, 12.0), (0.01, 1.0, 4.0), (0.005, 0.5, 2.0), (0.04, 3.0, 8.0)],
)
def test_planned_pulses_of_a_train_have_its_intensity(map_name, mapped, period_s, duration_s, intensity):
    train = {**TRAIN, "period_s": period_s, "duration_s": duration_s, "intensity": intensity}
    felt = feel_plan(mapped if map_name == "mapped" else CONFIG, {"trains": [train]})
    assert felt[200] == pytest.approx(intensity, rel=TOLERANCE)


def test_a_list_of_all_pixels_is_the_same_as_an_object():
    by_list = parse_sequence({"frames": [FRAME | {"intensity": [0.0] * 436 + [5.0]}]}, CONFIG, "f").frames[0]
    by_name = parse_sequence({"frames": [FRAME | {"intensity": {"436": 5}}]}, CONFIG, "f").frames[0]
    np.testing.assert_array_equal(by_list.target_m, by_name.target_m)
    assert np.flatnonzero(by_list.target_m).tolist() == [436]


def test_heights_rise_with_intensity_up_to_the_largest_displacement():
    display = DisplayModel.from_config(CONFIG)
    code, said = refusal({"frames": [FRAME | {"intensity": {"7": 500}}]})
    assert code == "target_unreachable"
    assert said.startswith("f: frames[0].intensity.7: got 500.0, expected at most 24.")
    assert said.endswith("the intensity of the longest pulse (50 ms at 2.45 W)")
    largest = float(said.split("at most ")[1].split(",")[0])
    values = np.linspace(0.01, largest, 40)
    frames = [FRAME | {"show_at_s": 2.0 * k, "intensity": {"7": value}} for k, value in enumerate(values.tolist())]
    heights_m = [frame.target_m[7] for frame in parse_sequence({"frames": frames}, CONFIG, "f").frames]
    assert (np.diff(heights_m) > 0).all()
    assert 0.98 * display.max_displacement_m[7] < heights_m[-1] <= display.max_displacement_m[7]


def test_a_train_beyond_its_largest_intensity_is_refused_and_at_it_accepted():
    code, said = refusal({"trains": [TRAIN | {"intensity": 24}]})
    assert code == "target_unreachable"
    assert said.startswith("f: trains[0].intensity: got 24.0, expected at most 23.")
    assert said.endswith("the largest of pulses every 40 ms")
    largest = float(said.split("at most ")[1].split(",")[0])
    (train,) = parse_sequence({"trains": [TRAIN | {"intensity": largest}]}, CONFIG, "f").trains
    assert isinstance(train, HeightTrain)
    assert train.peak_to_peak_m is None


def test_an_intensity_is_written_back_as_the_heights_it_stands_for():
    body = {"frames": [FRAME | {"intensity": {"5": 3}}], "trains": [TRAIN | {"start_s": 3.0, "intensity": 5}]}
    once = parse_sequence(body, CONFIG, "f")
    written = sequence_to_json(once)
    assert "intensity" not in str(written)
    assert sequence_to_json(parse_sequence(written, CONFIG, "f")) == written


@pytest.mark.parametrize(
    ("body", "code", "says"),
    [
        (
            {"frames": [FRAME | {"intensity": {"1": -1}}]},
            "bad_target",
            "intensity.1: got -1, expected an intensity ≥ 0",
        ),
        ({"frames": [FRAME | {"intensity": {"1": "5"}}]}, "bad_target", "got '5'"),
        ({"frames": [FRAME | {"intensity": {"1": True}}]}, "bad_target", "got True"),
        ({"frames": [FRAME | {"intensity": {"437": 5}}]}, "unknown_pixel", "got '437'"),
        ({"frames": [FRAME | {"intensity": [5]}]}, "bad_target", "expected 437 intensities, one per pixel"),
        ({"frames": [FRAME | {"intensity": 5}]}, "bad_target", "expected intensities by pixel"),
        ({"frames": [FRAME | {"intensity": {}, "target_um": {}}]}, "bad_target", "expected one of them"),
        ({"frames": [FRAME]}, "missing_key", "target_um: missing, expected this required key, or intensity"),
        ({"trains": [TRAIN]}, "missing_key", "target_um: missing, expected this required key, or intensity"),
        ({"trains": [TRAIN | {"intensity": 0}]}, "bad_target", "got 0, expected an intensity > 0"),
        ({"trains": [TRAIN | {"intensity": 5, "target_um": 90}]}, "bad_target", "expected one of them"),
        ({"trains": [TRAIN | {"intensity": 5, "peak_to_peak_um": 9}]}, "bad_train", "peak_to_peak_um: got 9"),
        (
            {"trains": [TRAIN | {"intensity": 5, "period_s": 0.0015}]},
            "target_unreachable",
            "got 5.0, expected a period of at least 2 ms: a faster vibration is not felt",
        ),
        ({"trains": [TRAIN | {"intensity": 5, "period_s": 1e-5}]}, "bad_train", "period_s: got 1e-05"),
    ],
)
def test_a_wrong_intensity_is_refused_in_one_line(body, code, says):
    refused_code, message = refusal(body)
    assert (refused_code, says in message) == (code, True), message


def test_the_work_for_a_frame_does_not_grow_with_its_intensities(mapped):
    few, many = (
        {"frames": [FRAME | {"intensity": np.linspace(1.0, 5.0, count).tolist() + [0.0] * (437 - count)}]}
        for count in (2, 437)
    )
    parse_sequence(few, mapped, "f")  # fills the tables
    lines = [count_lines(lambda: parse_sequence(body, mapped, "f")) for body in (few, many)]  # noqa: B023
    assert lines[1] < 1.1 * lines[0]


def test_the_number_of_different_trains_by_intensity_is_bounded():
    trains = [
        TRAIN | {"start_s": 0.2 * k, "duration_s": 0.05, "period_s": 0.02 + 1e-4 * k, "intensity": 1}
        for k in range(TRAIN_TABLES_MAX + 1)
    ]
    assert refusal({"trains": trains})[0] == "too_many"
    assert parse_sequence({"trains": [one | {"period_s": 0.03} for one in trains]}, CONFIG, "f").trains
