"""The wire format of the C core: vectors encode and decode, and invalid frames change only counters.

Invalid are refused frames and random bytes.
"""

import ctypes

import pytest
import test_messages as wire
from lockstep import Lockstep, arm
from order_scenarios import damaged

from optodrive.link.protocol import messages as m

SESSION = 0xBEEF


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


def condition(both):
    """Return the state that invalid frames must not change: all of the C core, and the simulated board's."""
    machine = both.python.machine
    queue = machine.queue
    counts = len(queue), queue.first_index, queue.next_index, machine.lease_until_us
    return both.c.fingerprint, machine.state, machine.gate, queue.job, machine._current_point, counts


def emit(library):
    """Return both boards, which emit a long pulse in the session of the vectors."""
    both = Lockstep(library, entropy=[SESSION, 7])
    arm(both)
    point = m.POINT.pack(32768, 32768, 0, 40_000, 9999)
    both.send(m.Data(0, point * 10), m.Start(1, 0, 0, 1), m.Lease(100))
    both.wait(5000)
    assert both.c.gate
    return both


@pytest.mark.parametrize("case", wire.REFUSED, ids=lambda case: case["what"])
def test_refused_frames_only_count(library, case):
    both = emit(library)
    before, answered = condition(both), len(both.received)
    both.raw(bytes.fromhex(case["wire"]))
    assert condition(both) == before
    assert len(both.received) == answered
    assert both.c.bad_frames == [int(case["counter"] == name) for name in ("crc_errors", "format_errors")]


def test_damaged_frames_only_count(library):
    both = emit(library)
    before, counted, answered = condition(both), 0, len(both.received)
    whole = both.frame(m.Data(10, m.POINT.pack(32768, 32768, 0, 1000, 65535)))
    for data in [
        *damaged(whole),
        both.frame(m.Abort())[:-2] + b"\0",
        bytes(range(256)) + b"\0",
        b"\xff" * 3000 + b"\0",
    ]:
        both.raw(data)
        assert condition(both) == before, data
        assert sum(both.c.bad_frames) > counted, data
        counted = sum(both.c.bad_frames)
    assert len(both.received) == answered
    both.send(m.Get())
    assert [both.received[-1].crc_errors, both.received[-1].format_errors] == both.c.bad_frames
