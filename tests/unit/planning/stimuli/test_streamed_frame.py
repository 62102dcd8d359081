"""Encodings, refusals and refresh order of streamed frames."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.stimuli.frame_json import parse_live_frame, stale_pixels_first


def binary(heights, number=7, magic=b"ODF1"):
    return struct.pack("<4sI", magic, number) + np.array(heights, dtype="<u2").tobytes()


def test_text_and_bytes_give_the_same_frame():
    number, by_bytes = parse_live_frame(binary([0, 500, 12345]), 0, 3)
    text_number, by_text = parse_live_frame('{"frame": 7, "target_um": {"1": 50, "2": 1234.5}}', 0, 3)
    assert number == text_number == 7
    assert by_bytes.frames[0].target_m == pytest.approx(by_text.frames[0].target_m, abs=1e-15)


def test_a_frame_without_a_number_gets_the_next_one():
    assert parse_live_frame('{"target_um": [1, 2, 3]}', 41, 3)[0] == 41


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (binary([1, 2]), "frame: got '12 bytes', expected 14 bytes: 8, and 2 for each of 3 pixels"),
        (binary([1, 2, 3], magic=b"ODF9"), "expected bytes that begin with ODF1"),
        (b"", "expected bytes that begin with ODF1"),
        ("{", "expected valid JSON"),
        ("[" * 100_000, "nests less deep"),
        ('{"target": {}}', "expected a known key, nearest is 'target_um'"),
        ("{}", "frame.target_um: missing"),
        ('{"frame": -1, "target_um": {}}', "frame.frame: got -1"),
        ('{"frame": true, "target_um": {}}', "frame.frame: got True"),
        ('{"target_um": {"3": 5}}', "frame.target_um: got '3', expected a pixel, 0…2"),
        ('{"target_um": [1, 2]}', "expected 3 heights, one per pixel"),
    ],
)
def test_bad_frames_are_refused_in_one_line(message, says):
    with pytest.raises(InputError) as refused:
        parse_live_frame(message, 0, 3)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@given(st.data())
def test_every_pixel_is_refreshed_at_any_frame_rate(data):
    """Of each frame one pixel is drawn and heights change. Within a cycle no pixel precedes the stale ones."""
    count = data.draw(st.integers(1, 12))
    refreshed = np.zeros(count, dtype=bool)
    active = np.array(data.draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    remaining = set(np.flatnonzero(active))
    for height_m in range(1, len(remaining) + 1):
        target_m = 1e-5 * height_m * active
        parts = stale_pixels_first(FrameSequence((TactileFrame("1", 0.0, 1.0, target_m),)), refreshed).frames
        assert sum(part.target_m for part in parts) == pytest.approx(target_m)
        first = data.draw(st.sampled_from(np.flatnonzero(parts[0].target_m).tolist()))
        assert first in remaining
        refreshed[first] = True
        remaining.discard(first)
    assert not remaining


def test_an_empty_frame_is_not_split():
    sequence = FrameSequence((TactileFrame("1", 0.0, 1.0, np.zeros(2)),))
    assert stale_pixels_first(sequence, np.zeros(2, dtype=bool)) == sequence
