"""Parsing, bounds, refusals and round trips of sequence files."""

import json
import re

import numpy as np
import pytest

from executed_lines import count_lines
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli import sequence_file, train_json
from optodrive.planning.stimuli.sequence_file import (
    load_sequence,
    parse_sequence,
    sequence_to_json,
    validate_sequence,
)

CONFIG = load_config("display-437")
FRAME = {"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50, "18": 120.5}}
TRAIN = {"pixel": 17, "start_s": 0.0, "duration_s": 0.3, "pulse_width_s": 0.020, "gap_s": 0.060, "power_w": 2.45}


def body(frames=(), trains=()):
    return {"frames": [{**FRAME, **frame} for frame in frames], "trains": [{**TRAIN, **train} for train in trains]}


def refusal(value, config=CONFIG):
    with pytest.raises(InputError) as caught:
        parse_sequence(value, config, "frames.json")
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 300
    return caught.value.code, message


def test_frames_and_trains_are_read():
    sequence = parse_sequence(json.dumps(body([{}, {"show_at_s": 0.5, "id": "two"}], [{}])).encode(), CONFIG, "f")
    first, second = sequence.frames
    assert (first.frame_id, first.show_at_s, first.duration_s) == ("frame-0", 0.0, 0.5)
    assert second.frame_id == "two"
    assert first.target_m.shape == (437,)
    assert first.target_m[17] == pytest.approx(50e-6)
    assert first.target_m[18] == pytest.approx(120.5e-6)
    assert np.count_nonzero(first.target_m) == 2
    (train,) = sequence.trains
    assert (train.pixel, train.duration_s, train.gap_s, train.power_w) == (17, 0.3, 0.06, 2.45)
    assert train.pulse_width_s == pytest.approx(0.020)


@pytest.mark.parametrize(
    ("frame", "code", "says"),
    [
        (
            {"target_um": {"17": -5}},
            "bad_target",
            "frames.json: frames[0].target_um.17: got -5, expected a height ≥ 0 in µm",
        ),
        ({"target_um": {"17": float("nan")}}, "bad_target", "target_um.17: got nan"),
        ({"target_um": {"16": 1, "17": True}}, "bad_target", "target_um.17: got True"),
        ({"target_um": {"17": 10**400}}, "bad_target", "target_um.17: got 1000"),
        ({"target_um": [1.0] * 436}, "bad_target", "got 'a list of 436', expected 437 heights"),
        ({"target_um": [1.0] * 400 + [-1] + [0] * 36}, "bad_target", "target_um.400: got -1"),
        ({"target_um": 50}, "bad_target", "target_um: got 50"),
        ({"target_um": {"437": 1}}, "unknown_pixel", "frames[0].target_um: got '437', expected a pixel, 0…436"),
        ({"target_um": {"017": 1}}, "unknown_pixel", "got '017'"),
        ({"target_um": {"x\n" * 90: 1}}, "unknown_pixel", "0…436"),
        (
            {"show_at_s": -0.1},
            "bad_time",
            "frames[0].show_at_s: got -0.1, expected a time ≥ 0 in s",
        ),
        ({"show_at_s": float("nan")}, "bad_time", "show_at_s: got nan"),
        ({"show_at_s": 1e6}, "bad_time", "at most 86400 s"),
        ({"duration_s": 0}, "bad_time", "duration_s: got 0"),
        ({"id": 7}, "bad_json", "id: got 7"),
        ({"id": "a\nb"}, "bad_json", r"id: got 'a\nb'"),
        ({"targt_um": {}}, "unknown_key", "frames[0]: got 'targt_um', expected a known key, nearest is 'target_um'"),
    ],
)
def test_an_invalid_frame_is_refused(frame, code, says):
    found, message = refusal(body([frame]))
    assert found == code
    assert says in message


@pytest.mark.parametrize("key", ["show_at_s", "duration_s", "target_um"])
def test_a_frame_without_a_required_key_is_refused(key):
    frame = {name: value for name, value in FRAME.items() if name != key}
    assert refusal({"frames": [frame]}) == (
        "missing_key",
        f"frames.json: frames[0].{key}: missing, expected this required key"
        + (", or intensity" if key == "target_um" else ""),
    )


@pytest.mark.parametrize("key", list(TRAIN))
def test_a_train_without_a_required_key_is_refused(key):
    train = {name: value for name, value in TRAIN.items() if name != key}
    assert refusal({"trains": [train]})[0] == "missing_key"


def test_frames_follow_each_other():
    at = [{"show_at_s": 0.0}, {"show_at_s": 0.5}, {"show_at_s": 1.0}]
    assert len(parse_sequence(body(at), CONFIG, "f").frames) == 3
    code, message = refusal(body([{"show_at_s": 1.0}, {"show_at_s": 0.2}]))
    assert (code, message) == (
        "bad_time",
        "frames.json: frames[1].show_at_s: got 0.2, expected frames in order of time, and frames[0] is shown at 1 s",
    )
    code, message = refusal(body([{}, {"show_at_s": 0.4}]))
    assert (code, message) == (
        "bad_time",
        "frames.json: frames[1].show_at_s: got 0.4, expected a time ≥ 0.5 s, when frames[0] ends",
    )


def test_abutting_frames_survive_the_rounding_of_sums():
    tenths = [{"show_at_s": sum([0.1] * k), "duration_s": 0.1} for k in range(50)]
    assert len(parse_sequence(body(tenths), CONFIG, "f").frames) == 50


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        (b'{"frames": []} x', "bad_json", "Extra data"),
        (b"\xff\xfe", "bad_json", "JSON in UTF-8"),
        (b"[]", "bad_json", "an object with frames, trains"),
        (b'{"frames": [], "trains": []}', "bad_json", "neither frames nor trains"),
        (b'{"frames": {}}', "bad_json", "frames: got {}, expected a list"),
        (b'{"frames": [7]}', "bad_json", "frames[0]: got 7, expected an object"),
        (b'{"frame": []}', "unknown_key", "got 'frame', expected a known key, nearest is 'frames'"),
        (b'{"frames": [], "frames": []}', "bad_json", "got 'frames', expected each key of an object once"),
        (b'{"frames": [' + b"9" * 5000 + b"]}", "bad_json", "numbers that fit"),
        (b"[" * 200_000, "bad_json", "nests less deep"),
    ],
)
def test_text_that_is_not_a_sequence_is_refused(text, code, says):
    found, message = refusal(text)
    assert found == code
    assert says in message


def test_a_value_nested_too_deep_for_its_repr_is_refused():
    deep = []
    for _ in range(5000):
        deep = [deep]
    code, message = refusal({"frames": [{**FRAME, "show_at_s": deep}]})
    assert code == "bad_time"
    assert "frames[0].show_at_s: got deeper nesting" in message


@pytest.mark.parametrize("literal", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_non_finite_numbers_are_refused_with_their_place(literal):
    text = json.dumps(body([{"target_um": {"17": 50}}])).replace("50", literal)
    code, message = refusal(text)
    assert code == "bad_target"
    assert "frames[0].target_um.17" in message
    code, message = refusal(json.dumps(body([], [{}])).replace("0.06", literal))
    assert code == "bad_train"
    assert "trains[0].gap_s" in message


def test_every_truncation_and_every_suffix_of_a_file_is_refused():
    whole = json.dumps(body([{}], [{}]))
    parse_sequence(whole + " \n", CONFIG, "f")
    for length in range(len(whole)):
        refusal(whole[:length])
    for tail in ("}", ",", "0", "{}", "\x00"):
        refusal(whole + tail)


def test_too_many_frames_or_trains_are_refused(monkeypatch):
    monkeypatch.setattr(sequence_file, "FRAMES_MAX", 2)
    monkeypatch.setattr(sequence_file, "TRAINS_MAX", 1)
    three = [{"show_at_s": k, "duration_s": 1} for k in range(3)]
    assert len(parse_sequence(body(three[:2], [{}]), CONFIG, "f").frames) == 2
    assert refusal(body(three)) == ("too_many", "frames.json: frames: got 3, expected at most 2 entries")
    assert refusal(body([], [{}, {"start_s": 1.0}]))[0] == "too_many"
    frame = TactileFrame("x", 0.0, 1.0, np.zeros(437))
    with pytest.raises(InputError, match="at most 2"):
        validate_sequence(FrameSequence(frames=(frame,) * 3), "pattern", CONFIG)


def test_the_documented_bounds_hold():
    assert (sequence_file.FRAMES_MAX, sequence_file.TRAINS_MAX, train_json.PULSES_MAX) == (10_000, 10_000, 2_000_000)
    assert refusal({"trains": [TRAIN] * 10_001})[0] == "too_many"
    empty = [{"show_at_s": k, "duration_s": 1, "target_um": {}} for k in range(10_001)]
    assert refusal({"frames": empty})[0] == "too_many"


def test_a_large_lattice_allows_fewer_frames(monkeypatch):
    monkeypatch.setattr(sequence_file, "TARGETS_MAX", 437 * 3)
    frames = [{"show_at_s": k, "duration_s": 1} for k in range(4)]
    assert len(parse_sequence(body(frames[:3]), CONFIG, "f").frames) == 3
    assert refusal(body(frames))[0] == "too_many"


def test_files_are_read(tmp_path):
    path = tmp_path / "frames.json"
    path.write_text("\ufeff" + json.dumps(body([{}])), encoding="utf-8")
    assert len(load_sequence(path, CONFIG).frames) == 1
    with pytest.raises(InputError, match="a readable file"):
        load_sequence(tmp_path / "none.json", CONFIG)
    with pytest.raises(InputError, match="a readable file"):
        load_sequence(tmp_path, CONFIG)
    path.write_text('{"frames": [}')
    with pytest.raises(InputError, match=re.escape("frames.json: got")):
        load_sequence(path, CONFIG)


def test_a_full_frame_of_the_largest_display_is_read_in_few_lines_per_pixel():
    config = load_config("display-1511")
    text = json.dumps({"frames": [{**FRAME, "target_um": {str(k): 50.0 for k in range(1511)}}]})
    parse_sequence(text, config, "f")
    assert count_lines(lambda: parse_sequence(text, config, "f")) < 12 * 1511


def test_a_priority_is_parsed_written_and_validated():
    sequence = parse_sequence(body([{"priority": 2}], [{"priority": -1}]), CONFIG, "f")
    assert (sequence.frames[0].priority, sequence.trains[0].priority) == (2, -1)
    written = sequence_to_json(sequence)
    assert written["frames"][0]["priority"] == 2
    assert parse_sequence(written, CONFIG, "f").trains == sequence.trains
    for value in ("high", 1.5, True, None, 10**9):
        for wrong in (body([{"priority": value}]), body([], [{"priority": value}])):
            code, message = refusal(wrong)
            assert code == "bad_priority"
            assert "priority: got" in message
            assert "expected a whole number" in message
