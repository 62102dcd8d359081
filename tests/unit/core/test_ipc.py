"""Messages between processes: any fragmentation, bounds, and the end of a connection."""

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.core.ipc import (
    HEADER_MAX_BYTES,
    MESSAGE_MAX_BYTES,
    IpcClosed,
    IpcError,
    Message,
    MessageDecoder,
    MessageSocket,
    encode_message,
)

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)
MESSAGES = st.builds(
    Message,
    st.text(),
    st.dictionaries(st.text().filter(lambda name: name != "kind"), VALUES, max_size=4),
    st.binary(max_size=200),
)


@given(st.lists(MESSAGES, max_size=5), st.data())
def test_messages_survive_any_fragmentation(messages, data):
    stream = b"".join(map(encode_message, messages))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    decoder, received = MessageDecoder(), []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        received += decoder.feed(stream[begin:end])
    assert received == messages


@given(MESSAGES)
def test_a_message_is_complete_only_with_its_last_byte(message):
    stream = encode_message(message)
    decoder = MessageDecoder()
    for k in range(len(stream) - 1):
        assert decoder.feed(stream[k : k + 1]) == []
    assert decoder.feed(stream[-1:]) == [message]


@given(st.binary(max_size=64))
def test_arbitrary_bytes_give_messages_or_an_ipc_error(data):
    decoder = MessageDecoder(max_bytes=1000)
    try:
        messages = decoder.feed(data)
    except IpcError:
        return
    assert all(isinstance(message.kind, str) for message in messages)


@pytest.mark.parametrize("header", [b"[]", b"{}", b"1", b'{"kind":1}', b"\xff", b"[" * 100_000, b"", b'{"kind":[]}'])
def test_a_header_that_names_no_kind_is_refused(header):
    lengths = (8 + len(header)).to_bytes(4, "little") + len(header).to_bytes(4, "little")
    with pytest.raises(IpcError):
        MessageDecoder().feed(lengths + header)


@pytest.mark.parametrize(
    ("total_bytes", "header_bytes"),
    [(MESSAGE_MAX_BYTES + 1, 10), (100, 93), (0, 0), (7, 0), (MESSAGE_MAX_BYTES, HEADER_MAX_BYTES + 1)],
)
def test_impossible_lengths_are_refused_before_the_rest_arrives(total_bytes, header_bytes):
    with pytest.raises(IpcError, match="length"):
        MessageDecoder().feed(total_bytes.to_bytes(4, "little") + header_bytes.to_bytes(4, "little"))


def test_a_message_beyond_the_bound_is_not_encoded():
    with pytest.raises(IpcError, match="at most"):
        encode_message(Message("big", {}, bytes(MESSAGE_MAX_BYTES)))


def test_a_field_that_is_no_json_value_is_an_ipc_error():
    with pytest.raises(IpcError, match="'odd'"):
        encode_message(Message("odd", {"value": object()}))


@pytest.fixture
def pair():
    left, right = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    with left, right:
        yield MessageSocket(left), MessageSocket(right)


def exchange(sender, receiver):
    """Flush and receive in turns until all bytes have arrived."""
    received = []
    while sender.wants_write:
        received += receiver.receive()
        sender.flush()
    for _ in range(20):
        received += receiver.receive()
    return received


def test_a_large_message_waits_for_its_reader_and_arrives(pair):
    sender, receiver = pair
    messages = [Message("big", {"n": 1}, bytes(range(256)) * 8000), Message("small", {})]
    for message in messages:
        sender.send(message)
    assert sender.wants_write
    assert exchange(sender, receiver) == messages


def test_no_message_is_no_end(pair):
    assert pair[0].receive() == []


def test_messages_before_the_end_arrive_and_then_the_end_is_reported(pair):
    sender, receiver = pair
    sender.send(Message("last", {}))
    sender.close()
    assert receiver.receive() == [Message("last", {})]
    with pytest.raises(IpcClosed):
        receiver.receive()
    with pytest.raises(IpcClosed):
        receiver.send(Message("late", {}))
    assert receiver.is_closed
    assert receiver.fileno() == -1


def test_sending_to_a_peer_that_is_gone_reports_its_end(pair):
    sender, receiver = pair
    receiver.close()
    with pytest.raises(IpcClosed):
        sender.send(Message("late", {}))


def test_a_peer_that_does_not_read_counts_as_lost():
    left, right = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    with left, right:
        sender = MessageSocket(left, out_max_bytes=1_000_000)
        status = Message("status", {}, bytes(50_000))
        for _ in range(19):
            sender.send(status)  # the operating system keeps some of them, the buffer the rest
        with pytest.raises(IpcClosed, match="unread"):
            sender.send(Message("status", {}, bytes(1_000_000)))
        assert sender.is_closed


def test_bytes_that_are_no_message_close_the_connection():
    left, right = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    with left, right:
        receiver = MessageSocket(left, max_bytes=1000)
        right.sendall(b"GET / HTTP/1.1\r\n\r\n")
        with pytest.raises(IpcError):
            receiver.receive()
        assert receiver.is_closed


def test_connect_reaches_a_listener_and_reports_a_missing_one(tmp_path):
    path = tmp_path / "link.sock"
    with pytest.raises(OSError, match="No such file"):
        MessageSocket.connect(path)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        client = MessageSocket.connect(path)
        server = MessageSocket(listener.accept()[0])
        client.send(Message("hello", {"role": "web"}))
        assert server.receive() == [Message("hello", {"role": "web"})]
        client.close()
        server.close()
