import pytest

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import RTO_S, WINDOW, HostConnection
from optodrive.link.protocol.framing import Frame, FrameDecoder, encode_frame

SESSION = 0x1234
PLENTY = 1 << 20
LIMITS = m.Limits(*range(14))


def hello_reply(nonce, session=SESSION):
    return m.HelloReply(1, 0, nonce, session, 1, bytes(12), 0, 1_000_000, 4096, 8, 1300, 2048, 8192, 0, LIMITS)


def wire(message, session=SESSION, seq=0):
    return encode_frame(Frame(message.TYPE, seq, session, message.encode_body()))


def frames(data):
    return list(FrameDecoder().feed(data))


def seqs(data):
    return [frame.seq for frame in frames(data)]


def data(number):
    return m.Data(number, m.POINT.pack(1, 2, 3, 4, 5))


@pytest.fixture
def host():
    connection = HostConnection()
    connection.send_hello(77)
    connection.bytes_to_send(0.0, PLENTY)
    connection.receive_bytes(wire(hello_reply(77)), 0.0)
    return connection


def ack(host, next_seq, now_s=0.0):
    return host.receive_bytes(wire(m.Ack(next_seq, 100, 0, 3)), now_s)


def nak(host, next_seq, reason, now_s=0.0):
    return host.receive_bytes(wire(m.Nak(next_seq, m.NAK_REASONS.index(reason))), now_s)


def fill(host, count):
    for number in range(count):
        host.send(data(number))


# --- hello ----------------------------------------------------------------------------------------------------------


def test_nothing_sequenced_is_sent_before_hello_reply():
    host = HostConnection()
    host.send_hello(5)
    host.send(data(0))
    sent = frames(host.bytes_to_send(0.0, PLENTY))
    assert sent == [Frame(m.Hello.TYPE, 0, 0, m.Hello(m.MAJOR, m.MINOR, 5).encode_body())]
    assert host.bytes_to_send(9.0, PLENTY) == b""
    assert host.outstanding == 1
    host.receive_bytes(wire(hello_reply(5)), 9.0)
    assert [frame[:3] for frame in frames(host.bytes_to_send(9.0, PLENTY))] == [(m.Data.TYPE, 0, SESSION)]


def test_a_repeated_hello_accepts_only_the_newest_reply():
    host = HostConnection()
    host.send_hello(5)
    host.send_hello(6)
    assert host.receive_bytes(wire(hello_reply(5, 111), session=111), 0.0) == []
    assert host.session == 0
    assert host.receive_bytes(wire(hello_reply(6, 222), session=222), 0.0) == [hello_reply(6, 222)]
    assert host.session == 222
    assert host.receive_bytes(wire(hello_reply(6, 333), session=333), 0.0) == []
    assert host.session == 222


def test_a_new_hello_clears_the_window(host):
    fill(host, 3)
    host.bytes_to_send(0.0, PLENTY)
    host.send_hello(78)
    host.bytes_to_send(0.0, PLENTY)
    host.receive_bytes(wire(hello_reply(78, 9), session=9), 0.0)
    host.send(data(50))
    assert frames(host.bytes_to_send(1.0, PLENTY)) == [Frame(m.Data.TYPE, 0, 9, data(50).encode_body())]


# --- window and flight budget ---------------------------------------------------------------------------------------


def test_window(host):
    fill(host, 12)
    assert seqs(host.bytes_to_send(0.0, PLENTY)) == list(range(WINDOW))
    assert host.bytes_to_send(0.0, PLENTY) == b""
    ack(host, 3)
    assert seqs(host.bytes_to_send(0.0, PLENTY)) == [8, 9, 10]
    assert host.outstanding == 9


def test_seq_wraps(host):
    sent = []
    for number in range(600):
        host.send(data(number))
        sent += seqs(host.bytes_to_send(0.0, PLENTY))
        ack(host, (number + 1) % 256)
    assert sent == [number % 256 for number in range(600)]
    assert host.outstanding == 0


def test_the_limit_of_bytes_in_flight_permits_at_least_one_frame(host):
    size = len(wire(data(0)))
    fill(host, 6)
    assert len(frames(host.bytes_to_send(0.0, 3 * size))) == 3
    assert host.bytes_to_send(0.0, 3 * size) == b""
    ack(host, 1)
    assert seqs(host.bytes_to_send(0.0, 3 * size)) == [3]
    ack(host, 4)
    assert seqs(host.bytes_to_send(0.0, 1)) == [4]


def test_unsequenced_messages_pass_a_full_window(host):
    fill(host, 20)
    host.bytes_to_send(0.0, PLENTY)
    host.send(m.Lease(100))
    assert [frame.type for frame in frames(host.bytes_to_send(0.0, PLENTY))] == [m.Lease.TYPE]


# --- loss -----------------------------------------------------------------------------------------------------------


def test_retransmission_after_the_timeout_and_not_before(host):
    fill(host, 3)
    first = host.bytes_to_send(0.0, PLENTY)
    assert host.bytes_to_send(RTO_S, PLENTY) == b""
    assert host.bytes_to_send(RTO_S * 1.01, PLENTY) == first
    assert host.bytes_to_send(RTO_S * 1.02, PLENTY) == b""
    assert host.bytes_to_send(RTO_S * 2.03, PLENTY) == first
    assert host.counters.retransmitted == 6


def test_an_acknowledgement_restarts_the_timeout(host):
    fill(host, 2)
    host.bytes_to_send(0.0, PLENTY)
    ack(host, 1, now_s=0.02)
    assert host.bytes_to_send(0.03, PLENTY) == b""
    assert seqs(host.bytes_to_send(0.046, PLENTY)) == [1]


def test_a_sequence_nak_triggers_retransmission_at_once(host):
    fill(host, 6)
    host.bytes_to_send(0.0, PLENTY)
    nak(host, 2, "SEQUENCE")
    assert seqs(host.bytes_to_send(0.001, PLENTY)) == [2, 3, 4, 5]
    assert host.counters.naks == 1


def test_a_gap_triggers_one_retransmission(host):
    fill(host, 8)
    host.bytes_to_send(0.0, PLENTY)
    sent = []
    for _ in range(5):
        nak(host, 2, "SEQUENCE")
        sent += seqs(host.bytes_to_send(0.001, PLENTY))
    assert sent == [2, 3, 4, 5, 6, 7]
    nak(host, 5, "SEQUENCE")  # progress, and a second gap
    assert seqs(host.bytes_to_send(0.002, PLENTY)) == [5, 6, 7]


def test_no_room_waits_for_the_timeout(host):
    fill(host, 3)
    host.bytes_to_send(0.0, PLENTY)
    nak(host, 1, "NO_ROOM", now_s=0.001)
    assert host.bytes_to_send(0.002, PLENTY) == b""
    assert seqs(host.bytes_to_send(0.03, PLENTY)) == [1, 2]


@pytest.mark.parametrize("reason", [name for name in m.NAK_REASONS if name not in m.NOT_CONSUMED])
def test_other_refusals_consume_the_frame(host, reason):
    fill(host, 2)
    host.bytes_to_send(0.0, PLENTY)
    assert nak(host, 2, reason) == [m.Nak(2, m.NAK_REASONS.index(reason))]
    assert host.outstanding == 0
    assert host.bytes_to_send(1.0, PLENTY) == b""


def test_old_and_impossible_acknowledgements_have_no_effect(host):
    fill(host, 5)
    host.bytes_to_send(0.0, PLENTY)
    ack(host, 3)
    for next_seq in (1, 2, 3, 6, 200):
        ack(host, next_seq)
        assert host.outstanding == 2
    assert seqs(host.bytes_to_send(1.0, PLENTY)) == [3, 4]


def test_acknowledgements_of_other_sessions_have_no_effect(host):
    fill(host, 2)
    host.bytes_to_send(0.0, PLENTY)
    assert host.receive_bytes(wire(m.Ack(2, 100, 0, 3), session=SESSION + 1), 0.0) == []
    assert host.outstanding == 2


def test_an_echo_is_a_format_error(host):
    fill(host, 1)
    host.send(m.Get())
    echo = host.bytes_to_send(0.0, PLENTY)
    assert host.receive_bytes(echo, 0.0) == []
    assert host.counters.format_errors == 2


def test_answers_byte_by_byte_and_followed_by_junk(host):
    fill(host, 2)
    host.bytes_to_send(0.0, PLENTY)
    stream = b"\x07junk\0" + wire(m.Ack(1, 5, 0, 3)) + wire(m.Ack(2, 6, 0, 3)) + b"\x02"
    taken = [message for byte in stream for message in host.receive_bytes(bytes([byte]), 0.0)]
    assert taken == [m.Ack(1, 5, 0, 3), m.Ack(2, 6, 0, 3)]
    assert host.outstanding == 0
    assert host.counters.format_errors == 1


# --- abort ----------------------------------------------------------------------------------------------------------


def test_abort_precedes_and_clears_everything(host):
    fill(host, 12)
    host.bytes_to_send(0.0, PLENTY)
    host.send(m.Lease(100))
    host.abort()
    assert frames(host.bytes_to_send(0.0, PLENTY)) == [Frame(m.Abort.TYPE, 0, SESSION, b"")]
    assert host.outstanding == 0
    host.send(data(0))
    assert host.bytes_to_send(9.0, PLENTY) == b""
    assert host.receive_bytes(wire(hello_reply(77)), 9.0) == []
    assert host.peer is None


def test_events_of_the_aborted_session_are_returned_until_the_next_one(host):
    event = m.Event(state=m.STATES.index("DISARMED"), reason=m.EVENT_REASONS.index("abort"), fault=0, tick=7)
    host.abort()
    host.send_hello(3)
    assert host.receive_bytes(wire(event), 0.0) == [event]
    assert host.receive_bytes(wire(event, session=SESSION ^ 1), 0.0) == []
    assert host.receive_bytes(wire(m.Ack(0, 0, 0, 0)), 0.0) == []
    host.receive_bytes(wire(hello_reply(3, 222), session=222), 0.0)
    assert host.receive_bytes(wire(event), 0.0) == []
    host.send_hello(4)  # without an abort, no event of the old session is returned
    assert host.receive_bytes(wire(event, session=222), 0.0) == []


def test_messages_for_the_next_session_survive_repeated_hellos(host):
    host.abort()
    host.send_hello(3)
    host.send(data(0))
    host.send_hello(4)
    host.receive_bytes(wire(hello_reply(4, 222), session=222), 0.0)
    host.send(m.Flush(), at_front=True)
    host.bytes_to_send(0.0, PLENTY)
    assert host.outstanding == 2


def test_abort_then_hello_keep_their_order(host):
    host.send(m.Get())
    host.abort()
    host.send_hello(3)
    assert [frame.type for frame in frames(host.bytes_to_send(0.0, PLENTY))] == [m.Abort.TYPE, m.Hello.TYPE]


# --- the board's end ------------------------------------------------------------------------------------------------
