import struct
from zlib import crc32

import pytest

from optodrive.core.errors import LocalProtocolError
from optodrive.link.protocol.framing import (
    BODY_MAX,
    ENCODED_MAX,
    RAW_MAX,
    Frame,
    FrameDecoder,
    cobs_decode,
    cobs_encode,
    encode_frame,
)

RAWS = [b"", b"\0", b"\0\0", b"a", b"a\0", b"\0a", b"a\0b", bytes(RAW_MAX), bytes(range(252)), b"\xff" * RAW_MAX]
FRAMES = [Frame(0x18, 0, 7, b""), Frame(0x10, 255, 65535, bytes(range(BODY_MAX))), Frame(0x04, 3, 0x0100, b"\0\0")]
STREAM = b"".join(encode_frame(frame) for frame in FRAMES)


def read(*portions):
    decoder = FrameDecoder()
    frames = [frame for portion in portions for frame in decoder.feed(portion)]
    return frames, (decoder.counters.crc_errors, decoder.counters.format_errors)


def one_by_one(data):
    return [data[k : k + 1] for k in range(len(data))]


@pytest.mark.parametrize("raw", RAWS, ids=repr)
def test_round_trip_without_zeros_and_with_at_most_one_byte_more(raw):
    encoded = cobs_encode(raw)
    assert 0 not in encoded
    assert len(encoded) == len(raw) + 1
    assert cobs_decode(encoded) == raw


def test_examples_of_the_paper():
    assert cobs_encode(b"\x00") == b"\x01\x01"
    assert cobs_encode(b"\x11\x22\x00\x33") == b"\x03\x11\x22\x02\x33"
    assert cobs_encode(b"\x11\x00\x00\x00") == b"\x02\x11\x01\x01\x01"


def test_too_long_to_encode():
    with pytest.raises(LocalProtocolError, match="253 bytes is longer than 252"):
        cobs_encode(bytes(RAW_MAX + 1))
    with pytest.raises(LocalProtocolError):
        encode_frame(Frame(0x10, 0, 1, bytes(BODY_MAX + 1)))


@pytest.mark.parametrize("encoded", [b"", b"\x00", b"\x02", b"\x03a", b"\xff" + b"a" * 254, b"\x01\x00"], ids=repr)
def test_invalid_cobs(encoded):
    assert cobs_decode(encoded) is None


def test_too_long_when_decoded():
    assert cobs_decode(b"\x01" * (RAW_MAX + 1)) == bytes(RAW_MAX)
    assert cobs_decode(b"\x01" * (RAW_MAX + 2)) is None


def test_frame_is_header_body_and_zlib_crc():
    raw = struct.pack("<BBH", 0x10, 9, 0x1234) + b"body"
    assert cobs_decode(encode_frame(Frame(0x10, 9, 0x1234, b"body"))[:-1]) == raw + struct.pack("<I", crc32(raw))


def test_a_frame_is_complete_at_its_delimiter():
    assert read(STREAM[:-1])[0] == FRAMES[:-1]


@pytest.mark.parametrize("cut", range(1, len(STREAM), 17))
def test_decoded_in_two_portions(cut):
    assert read(STREAM[:cut], STREAM[cut:]) == (FRAMES, (0, 0))


def test_trailing_junk_damages_no_other_frame():
    junk = b"\x05junk"
    assert read(STREAM + junk) == (FRAMES, (0, 0))
    assert read(STREAM + junk + b"\0" + STREAM) == (FRAMES * 2, (0, 1))


def test_leading_junk_damages_at_most_one_frame():
    frames, counted = read(b"junk" + STREAM)
    assert frames == FRAMES[1:]
    assert sum(counted) == 1


def test_empty_frames_are_ignored():
    assert read(b"\0\0\0" + STREAM + b"\0\0") == (FRAMES, (0, 0))


def test_short_frames_count_as_format_errors():
    for length in range(8):
        assert read(cobs_encode(bytes(length)) + b"\0") == ([], (0, 1))


@pytest.mark.parametrize("portions", [lambda data: [data], one_by_one], ids=["whole", "byte by byte"])
@pytest.mark.parametrize("length", [ENCODED_MAX + 1, 300, 5000])
def test_an_overlong_frame_counts_once_and_ends_at_its_delimiter(portions, length):
    assert read(*portions(b"\x07" * length + b"\0" + STREAM)) == (FRAMES, (0, 1))


def test_overlong_frames_use_bounded_memory():
    decoder = FrameDecoder()
    for _ in range(100):
        assert list(decoder.feed(b"\x07" * 1000)) == []
    assert len(decoder._pending) <= ENCODED_MAX
    assert decoder.counters.format_errors == 1


def test_every_flipped_bit_is_detected():
    wire = encode_frame(FRAMES[2])
    for at in range(len(wire) - 1):
        for bit in range(8):
            damaged = bytearray(wire)
            damaged[at] ^= 1 << bit
            assert read(bytes(damaged))[0] == []
