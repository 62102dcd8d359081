"""Validation, overlaps and limits of pulse trains and height trains from JSON."""

from dataclasses import replace

import numpy as np
import pytest

from executed_lines import count_lines
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import HeightTrain, PulseTrain
from optodrive.device.config_file import load_config
from optodrive.device.config_sections import StageSection
from optodrive.planning.stimuli.sequence_file import parse_sequence
from optodrive.planning.stimuli.train_json import check_trains, count_pulses, validate_train

CONFIG = load_config("display-437")
TRAIN = {"pixel": 17, "start_s": 0.0, "duration_s": 0.3, "pulse_width_s": 0.020, "gap_s": 0.060, "power_w": 2.45}


def parse(*changes):
    return parse_sequence({"trains": [{**TRAIN, **change} for change in changes]}, CONFIG, "frames.json").trains


def refusal(*changes):
    with pytest.raises(InputError) as caught:
        parse(*changes)
    message = str(caught.value)
    assert "\n" not in message
    return caught.value.code, message


@pytest.mark.parametrize(
    ("change", "code", "says"),
    [
        ({"pixel": 437}, "unknown_pixel", "frames.json: trains[0].pixel: got 437, expected a pixel, 0…436"),
        ({"pixel": True}, "unknown_pixel", "got True"),
        ({"start_s": -1e-6}, "bad_time", "start_s: got -1e-06"),
        ({"duration_s": 0}, "bad_time", "duration_s: got 0"),
        ({"gap_s": -0.001}, "bad_train", "gap_s: got -0.001"),
        ({"pulse_width_s": 0}, "bad_train", "pulse_width_s: got 0"),
        ({"pulse_width_s": 0.0502}, "bad_train", "at most limits.pulse_width_max_s = 0.05 s"),
        ({"pulse_width_s": 0.0201}, "bad_train", "got 0.0201, expected whole PWM periods of 0.0002 s, nearest is 0.02"),
        ({"pulse_width_s": 0.00001}, "bad_train", "nearest is 0.0002"),
        ({"power_w": 0}, "bad_train", "power_w: got 0"),
        (
            {"power_w": 2.5},
            "bad_train",
            "power_w: got 2.5, expected a power above 0, at most laser.max_power_w = 2.45 W",
        ),
        ({"pulse_width": 1}, "unknown_key", "got 'pulse_width', expected a known key, nearest is 'pulse_width_s'"),
    ],
)
def test_an_invalid_pulse_train_is_refused(change, code, says):
    found, message = refusal(change)
    assert found == code
    assert says in message


HEIGHTS = {"pixel": 17, "start_s": 0.0, "duration_s": 1.0, "period_s": 0.04, "target_um": 300, "peak_to_peak_um": 120}


def test_a_height_train_is_recognised_by_its_keys():
    (train,) = parse_sequence({"trains": [HEIGHTS]}, CONFIG, "f").trains
    assert train == HeightTrain(17, 0.0, 1.0, 0.04, pytest.approx(300e-6), pytest.approx(120e-6))
    assert len(train.pulse_starts_s()) == count_pulses(train) == 25
    (free,) = parse_sequence({"trains": [{**HEIGHTS, "peak_to_peak_um": None}]}, CONFIG, "f").trains
    assert free.peak_to_peak_m is None


@pytest.mark.parametrize(
    ("change", "code", "says"),
    [
        ({"pixel": 437}, "unknown_pixel", "frames.json: trains[0].pixel: got 437"),
        ({"period_s": 0.0006}, "bad_train", "trains[0].period_s: got 0.0006, expected at least 0.0007 s"),
        ({"period_s": 0}, "bad_train", "period_s: got 0"),
        ({"target_um": 0}, "bad_target", "target_um: got 0.0, expected a height > 0 in µm"),
        ({"peak_to_peak_um": 301}, "bad_train", "peak_to_peak_um: got 301.0, expected a height above 0, at most"),
        ({"power_w": 2}, "unknown_key", "got 'power_w', expected a known key"),
        ({"duration_s": 1001, "period_s": 0.01}, "too_many", "got 100100, expected at most 100000 pulses in all"),
    ],
)
def test_an_invalid_height_train_is_refused(change, code, says):
    with pytest.raises(InputError) as caught:
        parse_sequence({"trains": [{**HEIGHTS, **change}]}, CONFIG, "frames.json")
    assert caught.value.code == code
    assert says in str(caught.value)


def test_a_height_train_needs_its_keys_and_free_beam_time():
    for key in ("target_um", "period_s", "pixel"):
        with pytest.raises(InputError) as caught:
            parse_sequence({"trains": [{k: v for k, v in HEIGHTS.items() if k != key}]}, CONFIG, "f")
        assert caught.value.code == "missing_key"
    for other in ({**HEIGHTS, "start_s": 0.0001}, {**TRAIN, "start_s": 0.03}, TRAIN):
        with pytest.raises(InputError) as caught:
            parse_sequence({"trains": [HEIGHTS, other]}, CONFIG, "f")
        assert caught.value.code == "overlapping_trains"
    assert parse_sequence({"trains": [{**HEIGHTS, "start_s": 0.025}, {**TRAIN, "gap_s": 0.02}]}, CONFIG, "f").trains


def test_the_limits_themselves_are_allowed():
    parse({"pulse_width_s": 0.05, "gap_s": 0.0, "power_w": 2.45})
    parse({"pulse_width_s": 0.0002, "duration_s": 1e-9})


def test_a_width_near_whole_periods_is_rounded():
    (train,) = parse({"pulse_width_s": 0.020001})
    assert train.pulse_width_s == pytest.approx(0.02, abs=1e-15)
    assert refusal({"pulse_width_s": 0.020003})[0] == "bad_train"


def test_trains_of_a_laser_that_is_on_or_off():
    """They have full power and whole microseconds, and their height sets how far they fall."""
    table = CONFIG.model_dump()
    config = type(CONFIG).model_validate(table | {"laser": table["laser"] | {"modulation": "on_off"}})

    def refuse(train):
        with pytest.raises(InputError) as caught:
            parse_sequence({"trains": [train]}, config, "f")
        return str(caught.value)

    (train,) = parse_sequence({"trains": [TRAIN | {"power_w": 2.45, "pulse_width_s": 0.020003}]}, config, "f").trains
    assert train.pulse_width_s == pytest.approx(0.020003, abs=1e-12)
    assert "power_w: got 2.4, expected at least 2.45 W" in refuse(TRAIN | {"power_w": 2.4})
    width = refuse(TRAIN | {"power_w": 2.45, "pulse_width_s": 0.0200035})
    assert "whole microseconds, nearest is 0.02000" in width
    fall = refuse(HEIGHTS | {"peak_to_peak_um": 5})
    assert "peak_to_peak_um: got 5.0, expected none with laser.modulation 'on_off'" in fall
    alone = {key: value for key, value in HEIGHTS.items() if key != "peak_to_peak_um"}
    assert parse_sequence({"trains": [alone]}, config, "f").trains


def test_pulses_of_two_trains_at_once_are_refused():
    code, message = refusal({}, {"pixel": 18, "start_s": 0.03}, {"pixel": 19, "start_s": 0.165})
    assert code == "overlapping_trains"
    assert message == (
        "frames.json: trains[2]: got 0.165, expected a pulse after 0.18 s: until then the beam is in use by "
        "trains[0], from 0.16 s"
    )


def test_one_nanosecond_is_the_tolerance():
    assert parse({}, {"pixel": 18, "start_s": 0.02 - 0.9e-9})
    assert refusal({}, {"pixel": 18, "start_s": 0.02 - 1.2e-9})[0] == "overlapping_trains"


def test_too_many_pulses_are_refused_before_they_are_generated():
    code, message = refusal({"duration_s": 86_400, "pulse_width_s": 0.0002, "gap_s": 0.0002})
    assert code == "too_many"
    assert "got 216000000, expected at most 2000000 pulses" in message


def test_the_pulse_count_matches_the_generated_pulses():
    for duration_s in (0.001, 0.08, 0.0800001, 0.3, 1.0):
        train = PulseTrain(0, 0.0, duration_s, 0.02, 0.06, 1.0)
        assert count_pulses(train) == len(train.pulse_starts_s())


def test_a_hundred_thousand_pulses_are_checked_together():
    train = PulseTrain(0, 0.0, 1000.0, 0.0002, 0.0018, 1.0)
    many = [replace(train, pixel=k, start_s=0.0005 * k, duration_s=50.0) for k in range(4)]
    assert count_lines(lambda: check_trains(many, "trains", CONFIG)) < 1000
    assert sum(map(count_pulses, many)) == 100_000
    late = replace(train, pixel=9, start_s=49.9996, duration_s=0.001)
    with pytest.raises(InputError, match="the beam is in use"):
        check_trains([*many, late], "trains", CONFIG)


def test_another_laser_has_other_periods():
    config = CONFIG.model_copy(update={"laser": CONFIG.laser.model_copy(update={"pwm_hz": 1000.0})})
    train = PulseTrain(0, 0.0, 1.0, 0.0152, 0.1, 1.0)
    with pytest.raises(InputError, match=r"whole PWM periods of 0.001 s, nearest is 0.015"):
        validate_train(train, "t", config)
    assert np.isclose(validate_train(train, "t", CONFIG).pulse_width_s, 0.0152)


def test_as_many_trains_at_once_as_there_are_beams():
    sections = {"laser": CONFIG.laser, "scanner": CONFIG.scanner, "board": CONFIG.board}
    config = CONFIG.model_copy(update={"stages": tuple(StageSection(name=name, **sections) for name in "ab")})

    def refuse(*trains):
        with pytest.raises(InputError) as refused:
            parse_sequence({"trains": [{**TRAIN, **each} for each in trains]}, config, "f")
        return str(refused.value)

    assert parse_sequence({"trains": [TRAIN, {**TRAIN, "pixel": 18}]}, config, "f").trains
    text = refuse({}, {"pixel": 18, "start_s": 0.005}, {"pixel": 19, "start_s": 0.01})
    assert "trains[2]: got 0.01, expected a pulse after 0.02 s: until then all 2 beams are in use" in text
    assert "trains[1]: got 0.01, expected a pulse after 0.02 s: until then the beam is in use by trains[0]" in refuse(
        {}, {"start_s": 0.01}
    )
