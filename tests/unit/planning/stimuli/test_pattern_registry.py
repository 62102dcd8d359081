"""Defaults, argument conversion, refusals and documentation of the patterns."""

import json
from base64 import b64encode
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.daemon.responses.plan import PatternList
from optodrive.device.config_file import load_config
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.stimuli.pattern_registry import PATTERNS, build_pattern, describe_patterns
from optodrive.planning.stimuli.sequence_file import parse_sequence, sequence_to_json

CONFIG = load_config("display-437")


def picture():
    buffer = BytesIO()
    Image.new("L", (7, 7), 255).save(buffer, "PNG")
    return buffer.getvalue()


TAP = (
    b'{"Version": 1, "Pattern": [{"Event": {"Time": 0, "EventType": "HapticTransient", "EventParameters": '
    b'[{"ParameterID": "HapticIntensity", "ParameterValue": 1}]}}]}'
)
CLICK = b"RIFF,\0\0\0WAVEfmt \x10\0\0\0\1\0\1\0@\x1f\0\0@\x1f\0\0\1\0\x08\0data\x08\0\0\0\xff\0\xff\0\xff\0\xff\0"
NEEDED = {
    "text": {"text": "hello"},
    "image": {"file": picture()},
    "animation": {"file": picture()},
    "braille-file": {"file": b",HELLO"},
    "haptic-file": {"file": TAP},
    "sound": {"file": CLICK},
    "drawing": {
        "file": b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><path d="M0 0L9 9" stroke="red"/></svg>'
    },
}


def refusal(name, given, config=CONFIG):
    with pytest.raises(InputError) as caught:
        build_pattern(name, given, config)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 400
    return caught.value.code, message


@pytest.mark.parametrize("name", list(PATTERNS))
def test_every_pattern_plays_with_its_defaults(name):
    sequence = build_pattern(name, NEEDED.get(name, {}), CONFIG)
    assert sequence.frames or sequence.trains
    assert any(frame.target_m.any() for frame in sequence.frames) or sequence.trains
    assert all(a.show_at_s + a.duration_s <= b.show_at_s + 1e-9 for a, b in pairwise(sequence.frames))
    again = parse_sequence(json.dumps(sequence_to_json(sequence)), CONFIG, "again")
    assert again.trains == sequence.trains
    for one, two in zip(again.frames, sequence.frames, strict=True):
        assert (one.frame_id, one.show_at_s, one.duration_s) == (two.frame_id, two.show_at_s, two.duration_s)
        assert one.target_m == pytest.approx(two.target_m, rel=1e-12, abs=1e-15)


def test_only_stimuli_of_experiments_are_refused_rather_than_trimmed():
    assert {item.name for item in describe_patterns() if item.policy == "refuse"} == {
        "comparison",
        "detection",
        *(f"experiment-{k}" for k in range(1, 7)),
    }
    assert {item.policy for item in describe_patterns()} == {"refuse", "trim"}


def test_the_description_is_json():
    described = json.loads(PatternList(patterns=describe_patterns()).model_dump_json())["patterns"]
    assert [item["name"] for item in described] == list(PATTERNS)
    for item in described:
        assert item["summary"]
        for parameter in item["parameters"]:
            assert parameter["description"]
            assert parameter["required"] == (parameter["default"] is None and parameter["name"] in ("text", "file"))


def test_text_and_numbers_give_the_same_arguments():
    typed = build_pattern("all", {"height_um": "75.5", "seconds": "0"}, CONFIG)
    given = build_pattern("all", {"height_um": 75.5, "seconds": 0}, CONFIG)
    assert typed.frames[0].target_m == pytest.approx(75.5e-6)
    assert np.array_equal(typed.frames[0].target_m, given.frames[0].target_m)
    one = build_pattern("experiment-2", {"speed": "32", "direction": "ccw", "centre": "100"}, CONFIG)
    assert one == build_pattern("experiment-2", {"speed": 32, "direction": "ccw", "centre": 100}, CONFIG)


def test_a_file_is_bytes_or_base64():
    raw = build_pattern("image", {"file": picture()}, CONFIG)
    text = build_pattern("image", {"file": b64encode(picture()).decode()}, CONFIG)
    assert np.array_equal(raw.frames[0].target_m, text.frames[0].target_m)


def test_flags_are_true_or_false():
    for false in ("false", False):
        assert build_pattern("image", {"file": picture(), "invert": false}, CONFIG).frames[0].target_m.any()
    for true in ("true", True):
        with pytest.raises(InputError, match="raises nothing"):
            build_pattern("image", {"file": picture(), "invert": true}, CONFIG)


@pytest.mark.parametrize(
    ("name", "given", "code", "says"),
    [
        (
            "experiment-7",
            {},
            "unknown_pattern",
            "pattern: got 'experiment-7', expected a known pattern, nearest is 'experiment-",
        ),
        ("x" * 5000, {}, "unknown_pattern", "one of experiment-1"),
        ("hello", {}, "unknown_pattern", "got 'hello', expected a known pattern, one of experiment-1"),
        (
            "all",
            {"heigth_um": 5},
            "unknown_parameter",
            "pattern all: got 'heigth_um', expected a known parameter, nearest is 'height_um'",
        ),
        ("showcase", {"seconds": 5}, "unknown_parameter", "expected no parameter"),
        ("all", [1], "bad_parameter", "got [1], expected an object"),
        ("text", {}, "missing_parameter", "pattern text: text: missing"),
        ("image", {}, "missing_parameter", "pattern image: file: missing"),
        (
            "all",
            {"height_um": -5},
            "bad_parameter",
            "pattern all: height_um: got -5, expected a number from 1 to 1000 µm",
        ),
        ("all", {"height_um": "nan"}, "bad_parameter", "got 'nan'"),
        ("all", {"height_um": True}, "bad_parameter", "got True"),
        ("all", {"height_um": 10**400}, "bad_parameter", "expected a number"),
        ("all", {"seconds": -1}, "bad_parameter", "from 0 to 600 s"),
        ("pixel", {"pixel": 437}, "unknown_pixel", "pattern pixel: pixel: got 437, expected a whole number, 0…436"),
        ("pixel", {"pixel": "9" * 5000}, "unknown_pixel", "0…436"),
        ("experiment-3", {"target": 0}, "bad_parameter", "target: got 0, expected a whole number, 1…9"),
        ("experiment-3", {"target": True}, "bad_parameter", "got True"),
        ("experiment-4", {"level": "²"}, "bad_parameter", "got '²'"),
        ("experiment-1", {"direction": "north"}, "bad_parameter", "got 'north', expected one of left, right, up, down"),
        ("experiment-2", {"speed": 20}, "bad_parameter", "got 20, expected one of 16, 32, 64"),
        ("experiment-1", {"centre": 0}, "does_not_fit", "pattern experiment-1: centre: got 0, expected a pixel with"),
        ("image", {"file": picture(), "invert": "maybe"}, "bad_parameter", "got 'maybe', expected true or false"),
        ("image", {"file": "no base64!"}, "bad_parameter", "the bytes of a file"),
        ("image", {"file": b"no picture"}, "bad_picture", "pattern image: file: got b'no picture', expected a picture"),
        ("animation", {"file": picture(), "rate_hz": 0}, "bad_parameter", "from 0.01 to 50 Hz"),
        ("text", {"text": ""}, "bad_parameter", "1 to 2000 characters"),
        ("text", {"text": "a" * 2001}, "bad_parameter", "1 to 2000 characters"),
        ("text", {"text": "é"}, "bad_text", "LATIN SMALL LETTER E WITH ACUTE"),
        ("text", {"text": "ab " * 600, "seconds": 600}, "too_many", "at most 10000"),
        ("circle", {"radius_mm": 500}, "does_not_fit", "radius_mm: got 500.0"),
    ],
)
def test_invalid_requests_are_refused_in_one_line(name, given, code, says):
    found, message = refusal(name, given)
    assert found == code
    assert says in message


def test_patterns_respect_the_limits_of_the_display():
    limits = CONFIG.limits.model_copy(update={"pulse_width_max_s": 0.02})
    tight = CONFIG.model_copy(update={"limits": limits})
    assert build_pattern("experiment-1", {}, tight).trains
    code, message = refusal("experiment-3", {}, tight)
    assert code == "bad_train"
    assert "pattern experiment-3: trains[0].pulse_width_s: got 0.025" in message
    weak = CONFIG.model_copy(update={"laser": CONFIG.laser.model_copy(update={"max_power_w": 1.0})})
    assert build_pattern("experiment-4", {"level": 9}, weak).trains[0].power_w == 1.0


def test_full_frames_last_as_long_as_the_beam_needs_on_every_display():
    for name in ("display-16", "display-357", "display-1511"):
        config = load_config(name)
        for frame in build_pattern("all", {}, config).frames:
            assert frame.duration_s >= len(frame.target_m) * 2.8e-3


REFERENCE = Path(__file__).parents[4] / "docs" / "reference"


def test_the_documented_example_is_read():
    page = (REFERENCE / "formats" / "frames-json.md").read_text(encoding="utf-8")
    example = page.partition("```json")[2].partition("```")[0]
    sequence = parse_sequence(example, CONFIG, "docs")
    assert (len(sequence.frames), len(sequence.trains)) == (2, 2)


BY_INTENSITY = [
    ("pixel", {"pixel": 30}),
    ("all", {}),
    ("checker", {"seconds": 0.2}),
    ("circle", {}),
    ("square", {}),
    ("edge", {}),
    ("dot", {}),
    ("text", {"text": "hello"}),
    ("braille-file", {"file": b",HELLO"}),
]


@pytest.mark.parametrize(("name", "given"), BY_INTENSITY)
def test_a_pattern_by_intensity_raises_the_same_pixels_to_the_heights_of_a_frame_by_intensity(name, given):
    by_height = build_pattern(name, {**given, "height_um": 60}, CONFIG)
    sequence = build_pattern(name, {**given, "intensity": 4}, CONFIG)
    frame = {"show_at_s": 0.0, "duration_s": 60.0, "intensity": [4.0] * 437}
    target_m = parse_sequence({"frames": [frame]}, CONFIG, "f").frames[0].target_m
    pictures = {frame.target_m.tobytes() for frame in sequence.frames}
    assert pictures == {np.where(frame.target_m > 0, target_m, 0.0).tobytes() for frame in by_height.frames}
    model = DISPLAYS["display-437"]
    assert check_feasibility(model, sequence, *model.build_cold_state())[1].fits


def test_a_vibration_by_intensity_is_a_train_by_intensity():
    (train,) = build_pattern("vibration", {"pixel": 30, "intensity": "8", "rate_hz": 40, "seconds": 0.5}, CONFIG).trains
    entry = {"pixel": 30, "start_s": 0.0, "duration_s": 0.5, "period_s": 0.025, "intensity": 8}
    assert parse_sequence({"trains": [entry]}, CONFIG, "f").trains == (train,)


def test_every_pattern_of_one_height_takes_an_intensity():
    taking = {item.name for item in describe_patterns() if any(each.name == "intensity" for each in item.parameters)}
    assert taking == {"vibration", *(name for name, _ in BY_INTENSITY)}


@pytest.mark.parametrize(
    ("name", "given", "code", "says"),
    [
        ("all", {"intensity": 90}, "target_unreachable", "pattern all: intensity.0: got 90.0, expected at most 24."),
        ("all", {"intensity": 0}, "bad_parameter", "pattern all: intensity: got 0, expected a number from 0.01"),
        ("all", {"intensity": 4, "height_um": 50}, "bad_parameter", "height_um: got 50, expected none beside"),
        ("vibration", {"intensity": 4, "peak_to_peak_um": 9}, "bad_parameter", "peak_to_peak_um: got 9, expected none"),
        ("vibration", {"intensity": 90}, "target_unreachable", "pattern vibration: intensity: got 90.0"),
        ("image", {"intensity": 4, "file": b""}, "unknown_parameter", "got 'intensity'"),
    ],
)
def test_a_wrong_intensity_of_a_pattern_is_refused(name, given, code, says):
    with pytest.raises(InputError) as refused:
        build_pattern(name, given, CONFIG)
    assert refused.value.code == code
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_is_recorded_of_a_pattern_by_intensity_has_no_height():
    recorded = PATTERNS["all"].describe_arguments({"intensity": 4}, CONFIG)
    assert (recorded["intensity"], recorded["height_um"]) == (4, None)
    recorded = PATTERNS["all"].describe_arguments({}, CONFIG)
    assert (recorded["intensity"], recorded["height_um"]) == (None, 50.0)


def test_the_document_names_every_pattern():
    page = (REFERENCE / "patterns.md").read_text(encoding="utf-8")
    for pattern in PATTERNS.values():
        if not pattern.name.startswith("experiment"):
            assert f"`{pattern.name}`" in page
