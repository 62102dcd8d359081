"""Encoded sequences: equal after decoding, compact, and bounded."""

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.planning.stimuli import sequence_file
from optodrive.planning.stimuli.sequence_file import decode_sequence, encode_sequence

TRAINS = (PulseTrain(3, 0.0, 1.0, 0.01, 0.01, 2.0, 4), HeightTrain(5, 0.5, 1.0, 0.1, 1e-4, None, -2))


def build_frame(driven, pixels=1511, **fields):
    target_m = np.zeros(pixels)
    target_m[:driven] = np.random.default_rng(driven).random(driven)
    return TactileFrame(f"f{driven}", 0.25 * driven, 0.25, target_m, **fields)


@pytest.mark.parametrize(
    "sequence",
    [
        FrameSequence((), TRAINS),
        FrameSequence((build_frame(0), build_frame(7, simultaneous=True), build_frame(1511, priority=3)), TRAINS),
        FrameSequence(tuple(build_frame(1511) for _ in range(400))),
    ],
)
def test_a_decoded_sequence_equals_the_encoded_one(sequence):
    decoded = decode_sequence(encode_sequence(sequence))
    assert decoded.trains == sequence.trains
    for frame, copy in zip(sequence.frames, decoded.frames, strict=True):
        np.testing.assert_array_equal(copy.target_m, frame.target_m)
        assert not copy.target_m.flags.writeable
        for name in ("frame_id", "show_at_s", "duration_s", "simultaneous", "priority"):
            assert getattr(copy, name) == getattr(frame, name)


def test_the_largest_number_of_empty_frames_stays_small():
    blank = build_frame(0)
    assert len(encode_sequence(FrameSequence((blank,) * 10_000))) < 2_000_000


def test_a_sequence_beyond_the_bound_is_refused(monkeypatch):
    monkeypatch.setattr(sequence_file, "ENCODED_MAX_BYTES", 100_000)
    with pytest.raises(InputError, match="send it in parts"):
        encode_sequence(FrameSequence(tuple(build_frame(1511) for _ in range(10))))
