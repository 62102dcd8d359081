"""The wire format of the C core: vectors encode and decode; refused frames and random bytes change only counters."""

import ctypes

import pytest
import test_messages as wire
from c_board import CBench
from lockstep import Lockstep

from c_core import CBoard
from optodrive.link.protocol import messages as m

SESSION = 0xBEEF


def bench_in_session(library):
    """Return a core with the session of the vectors."""
    b = CBench(library)
    b.core = CBoard(library, sink=b.log.append, entropy=[SESSION, 0x1234_5678])
    b.hello()
    assert b.session == SESSION
    return b


@pytest.mark.parametrize("stem", wire.VECTORS)
def test_vector_encodes(library, stem):
    vector = wire.VECTORS[stem]
    body = bytes.fromhex(vector["raw"])[4:-4]
    out = ctypes.create_string_buffer(254)
    length = library.frame_encode(out, vector["type"], vector["seq"], vector["session"], body, len(body))
    assert ctypes.string_at(out, length).hex() == vector["wire"]


@pytest.mark.parametrize("portion", [1, 5, 1000], ids=["byte by byte", "by fives", "whole"])
@pytest.mark.parametrize("stem", wire.VECTORS)
def test_vector_is_answered_as_the_python_board_answers(library, stem, portion):
    vector = wire.VECTORS[stem]
    both = Lockstep(library, entropy=[SESSION, 7])
    both.send(m.Hello(1, 0, 42))
    both.send(*[m.Disarm()] * vector["seq"])
    data = bytes.fromhex(vector["wire"])
    for at in range(0, len(data), portion):
        both.raw(data[at : at + portion])
    both.send(m.Get())
    status = both.received[-1]
    assert (status.crc_errors, status.format_errors) == (0, 0)
    assert status.seq_errors == (wire.STATED[vector["message"]]["from"] == "board")


@pytest.mark.parametrize("case", wire.REFUSED, ids=lambda case: case["what"])
def test_refused_frames_only_count(library, case):
    b = bench_in_session(library)
    before = b.condition()
    assert b.raw(bytes.fromhex(case["wire"])) == []
    assert b.condition() == before
    assert b.bad_frames() == [int(case["counter"] == name) for name in ("crc_errors", "format_errors")]
