"""Any JSON, text and image is parsed correctly or refused in one line."""

import json
from io import BytesIO

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.stimuli.braille import DIGITS, PUNCTUATION
from optodrive.planning.stimuli.frame_json import HEIGHT, HEIGHT_MIN_UM
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.sequence_file import parse_sequence, sequence_to_json
from optodrive.planning.stimuli.train_json import LONG_INTERVAL_S

CONFIG, DISPLAY = load_config("display-16"), DISPLAYS["display-16"]
HEIGHTS = st.just(0.0) | st.floats(HEIGHT_MIN_UM, 2000)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
FRAME = {"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"3": 50}}
TRAIN = {"pixel": 3, "start_s": 0.0, "duration_s": 0.3, "pulse_width_s": 0.02, "gap_s": 0.06, "power_w": 2.0}


def is_accepted(value):
    """Return whether a sequence was parsed. Any error but a one-line refusal fails."""
    try:
        parse_sequence(value, CONFIG, "frames.json")
    except InputError as error:
        return not _is_one_line(error)
    return True


def parse_or_refuse(value):
    """Return a sequence, or the code of a one-line refusal."""
    try:
        return parse_sequence(value, CONFIG, "frames.json")
    except InputError as error:
        return error.code if _is_one_line(error) else None


def _is_one_line(error):
    assert "\n" not in str(error)
    return True


def heights_of(entry):
    """Return the heights of a frame, µm."""
    target = entry["target_um"]
    return list(target.values()) if isinstance(target, dict) else target


@example([(1.0, 0.0, {0: 0.5})], 1, 0.0, 1.0)
@given(
    st.lists(
        st.tuples(
            st.floats(1e-3, 10),
            st.floats(0, 1),
            st.dictionaries(st.integers(0, 15), HEIGHTS) | st.lists(HEIGHTS, min_size=16, max_size=16),
        ),
        min_size=1,
        max_size=5,
    ),
    st.integers(1, 250),
    st.floats(0, LONG_INTERVAL_S, exclude_max=True),
    st.floats(0.01, 2.45),
)
def test_sequences_round_trip(frames, periods, gap_s, power_w):
    entries, at_s = [], 0.0
    for duration_s, pause_s, heights in frames:
        target = {str(pixel): h for pixel, h in heights.items()} if isinstance(heights, dict) else heights
        entries.append({"show_at_s": at_s, "duration_s": duration_s, "target_um": target})
        at_s += duration_s + pause_s
    train = {**TRAIN, "pulse_width_s": periods / 5000, "gap_s": gap_s, "power_w": power_w}
    text = json.dumps({"frames": entries, "trains": [train]})
    if 0.0 < max(max(heights_of(entry), default=0.0) for entry in entries) < HEIGHT.low * (1.0 - 1e-9):
        with pytest.raises(InputError, match="a highest pixel of at least 1 µm"):
            parse_sequence(text, CONFIG, "f")
        return
    once = parse_sequence(text, CONFIG, "f")
    again = parse_sequence(json.dumps(sequence_to_json(once)), CONFIG, "f")
    assert again.trains == once.trains
    for one, two, entry in zip(once.frames, again.frames, entries, strict=True):
        assert (one.frame_id, one.show_at_s, one.duration_s) == (two.frame_id, two.show_at_s, two.duration_s)
        assert np.allclose(one.target_m, two.target_m, rtol=1e-12, atol=1e-15)
        target = entry["target_um"]
        expected_um = [target.get(str(k), 0.0) for k in range(16)] if isinstance(target, dict) else target
        assert np.allclose(one.target_m, np.array(expected_um) * 1e-6, rtol=1e-12, atol=0)


@given(
    st.dictionaries(st.integers(0, 15), st.floats(0, 40)),
    st.floats(0, 40, exclude_min=True),
    st.floats(1e-3, 0.5),
    st.floats(1e-2, 2.0),
)
def test_intensities_are_reachable_heights_or_refused(intensities, train_intensity, period_s, duration_s):
    frame = {"show_at_s": 0.0, "duration_s": 0.5, "intensity": {str(key): value for key, value in intensities.items()}}
    train = {"pixel": 3, "start_s": 0.5, "duration_s": duration_s, "period_s": period_s, "intensity": train_intensity}
    for body in ({"frames": [frame]}, {"trains": [train]}):
        sequence = parse_or_refuse(body)
        if "frames" in body and not any(intensities.values()):
            assert sequence == "raises_nothing"
            continue
        if isinstance(sequence, str):
            assert sequence in ("target_unreachable", "bad_train")
            continue
        for each in sequence.frames:
            assert (each.target_m <= DISPLAY.max_displacement_m).all()
            assert np.flatnonzero(each.target_m).tolist() == sorted(key for key in intensities if intensities[key] > 0)
        cold, budget = DISPLAY.build_cold_state()
        check_feasibility(DISPLAY, sequence, cold, budget)  # refuses no height of a train
        assert sequence_to_json(parse_sequence(sequence_to_json(sequence), CONFIG, "f")) == sequence_to_json(sequence)


@given(st.sampled_from(["show_at_s", "duration_s", "intensity"]), JSON)
def test_any_value_in_a_frame_by_intensity_is_parsed_or_refused(key, value):
    frame = {"show_at_s": 0.0, "duration_s": 0.5, "intensity": {"3": 5}}
    if is_accepted({"frames": [{**frame, key: value}]}):
        assert type(value) in ((dict, list) if key == "intensity" else (int, float))


@given(JSON)
def test_any_json_is_parsed_or_refused(value):
    assert not is_accepted(value)
    assert not is_accepted(json.dumps(value))


@given(st.sampled_from(sorted(FRAME)), JSON)
def test_any_value_in_a_frame_is_parsed_or_refused(key, value):
    if is_accepted({"frames": [{**FRAME, key: value}]}):
        assert type(value) in ((dict, list) if key == "target_um" else (int, float))


@given(st.sampled_from(sorted(TRAIN)), JSON)
def test_any_value_in_a_train_is_parsed_or_refused(key, value):
    if is_accepted({"trains": [{**TRAIN, key: value}]}):
        assert type(value) in (int, float)


@given(st.binary(max_size=60))
def test_any_bytes_are_refused(body):
    assert not is_accepted(body)


@given(
    st.lists(
        st.tuples(st.integers(0, 15), st.integers(0, 400), st.integers(1, 60), st.integers(0, 60), st.integers(1, 300)),
        min_size=2,
        max_size=5,
    )
)
def test_overlaps_match_a_comparison_of_every_pair(rows):
    """Times are in PWM periods, so that both sides are exact."""
    entries = [
        dict(zip(TRAIN, (p, at / 5000, long / 5000, wide / 5000, gap / 5000, 1.0), strict=True))
        for p, at, wide, gap, long in rows
    ]
    spans = [
        [(at + k * (wide + gap), at + k * (wide + gap) + wide) for k in range(-(-long // (wide + gap)))]
        for _, at, wide, gap, long in rows
    ]
    clash = any(a < d and c < b for i, one in enumerate(spans) for two in spans[:i] for a, b in one for c, d in two)
    assert is_accepted({"trains": entries}) != clash


@given(
    st.text(
        alphabet=st.sampled_from(["a", "j", "k", "Z", *DIGITS, *PUNCTUATION, " ", "\n", '"']), min_size=1, max_size=40
    )
)
@settings(max_examples=50, deadline=None)
def test_supported_text_is_shown_completely(text):
    if not text.strip():
        return
    config = load_config("display-437")
    sequence = build_pattern("text", {"text": text, "seconds": 0}, config)
    assert sum(np.count_nonzero(frame.target_m) for frame in sequence.frames) == _dots(text)


def _dots(text):
    from optodrive.planning.stimuli.braille import encode_word

    return sum(len(cell) for word in text.split() for cell in encode_word(word))


def _pictures():
    rng = np.random.default_rng(5)
    moving = [Image.fromarray(rng.integers(0, 256, (24, 20), dtype=np.uint8)) for _ in range(3)]
    for kind in ("PNG", "GIF", "JPEG"):
        buffer = BytesIO()
        extra = {} if kind == "JPEG" else {"save_all": True, "append_images": moving[1:], "duration": 40}
        moving[0].save(buffer, kind, **extra)
        yield buffer.getvalue()


PICTURES = list(_pictures())


@pytest.mark.parametrize("name", ["image", "animation"])
@given(data=st.data())
@settings(max_examples=2 * settings.default.max_examples, deadline=None)
def test_a_damaged_image_is_decoded_or_refused(name, data):
    file = bytearray(data.draw(st.sampled_from(PICTURES)))
    for _ in range(data.draw(st.integers(1, 6))):
        file[data.draw(st.integers(0, len(file) - 1))] = data.draw(st.integers(0, 255))
    file = bytes(file[: data.draw(st.integers(len(file) // 2, len(file)))])
    try:
        sequence = build_pattern(name, {"file": file}, CONFIG)
    except InputError as error:
        _is_one_line(error)
        return
    for frame in sequence.frames:
        assert frame.duration_s > 0
        assert np.all((frame.target_m >= 0) & (frame.target_m <= 50e-6 * (1 + 1e-6)))
