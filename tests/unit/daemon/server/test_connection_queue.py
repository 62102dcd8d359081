"""Connections that wait to be opened, over real sockets."""

import socket
from contextlib import ExitStack

import pytest

from optodrive.daemon.server import connection_queue
from optodrive.daemon.server.connection_queue import PHASE_MAX_S, WAIT_MAX_S, WAITING_MAX, ConnectionQueue
from optodrive.daemon.server.connections import Rank
from optodrive.daemon.server.listeners import open_tcp_listener

RANKS = {b"S": Rank.STOP, b"T": Rank.TOKEN, b"O": Rank.OTHER}
END = b"\r\n\r\n"


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def stack():
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def room(clock, stack):
    listener = stack.enter_context(open_tcp_listener("127.0.0.1", 0))
    room = ConnectionQueue([listener], lambda head: RANKS[head[:1]], clock)
    room.port = listener.getsockname()[1]
    stack.callback(room.close)
    return room


@pytest.fixture
def connect(room, stack):
    def connect(data=b""):
        link = stack.enter_context(socket.create_connection(("127.0.0.1", room.port)))
        link.sendall(data)
        return link

    return connect


def receive_all(room):
    for _ in range(50):
        room.receive()


def take_texts(room, stack):
    return [stack.enter_context(room.take(rank).sock).recv(100) for rank in Rank for _ in range(room.count(rank))]


def is_closed(link):
    link.setblocking(False)
    try:
        return link.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True


def test_of_one_rank_who_came_first_leaves_first(room, connect, stack):
    texts = [rank + number + END for number in (b"1", b"2") for rank in (b"O", b"T", b"S")]
    for head in texts:
        connect(head)
    receive_all(room)
    assert take_texts(room, stack) == sorted(texts, key=lambda head: (RANKS[head[:1]], head))
    with pytest.raises(KeyError):
        room.take(Rank.OTHER)


def test_who_is_put_back_is_the_first_again(room, connect):
    for _ in range(3):
        connect(b"T" + END)
    receive_all(room)
    first = room.take(Rank.TOKEN)
    room.put_back(first)
    with room.take(Rank.TOKEN).sock as sock:
        assert sock is first.sock
    assert room.count(Rank.TOKEN) == 2


def test_a_connection_waits_for_its_whole_head(room, connect, stack, clock):
    link = connect(b"T")
    receive_all(room)
    assert (len(room), room.count(Rank.TOKEN)) == (1, 0)
    clock.now_s += 1.0
    link.sendall(END)
    receive_all(room)
    waiting = room.take(Rank.TOKEN)
    with waiting.sock:
        assert (waiting.since_s, waiting.sock.recv(100)) == (clock.now_s, b"T" + END)


@pytest.mark.parametrize("data", [b"", b"T"])
def test_a_connection_that_ends_before_its_request_is_forgotten(room, connect, data):
    early, late = connect(data), connect(data)
    early.close()
    receive_all(room)
    late.close()
    receive_all(room)
    assert len(room) == 0


def test_who_waits_too_long_is_closed(room, connect, clock):
    links = {rank: connect(text + END) for text, rank in RANKS.items()}
    silent, partial = connect(), connect(b"T")
    receive_all(room)
    unserved = []
    room.on_unserved = lambda waiting: unserved.append((waiting.rank, waiting.sock.recv(1, socket.MSG_PEEK)))
    clock.now_s += min(WAIT_MAX_S, PHASE_MAX_S["headers"]) - 0.1
    room.close_expired()
    assert len(room) == 5
    clock.now_s += 0.2 + abs(WAIT_MAX_S - PHASE_MAX_S["headers"])
    room.close_expired()
    assert all(is_closed(link) for link in (*links.values(), silent, partial))
    assert len(room) == 0
    assert unserved == [(rank, text) for text, rank in RANKS.items()]


@pytest.mark.parametrize("flood", [b"", b"O" + END])
def test_those_of_whom_there_are_most_give_way_first(room, connect, flood, monkeypatch):
    monkeypatch.setattr(connection_queue, "WAITING_MAX", 20)
    kept = [connect(text) for text in (b"S" + END, b"T" + END, b"O" + END if not flood else b"")]
    receive_all(room)
    others = [connect(flood) for _ in range(40)]
    receive_all(room)
    assert not any(map(is_closed, kept))
    assert [is_closed(link) for link in others] == [True] * 23 + [False] * 17


def test_a_token_gives_way_only_to_tokens(room, connect, monkeypatch):
    monkeypatch.setattr(connection_queue, "WAITING_MAX", 10)
    other, *trusted = [connect(text + END) for text in (b"O", *[b"T"] * 12)]
    receive_all(room)
    assert is_closed(other)
    assert [is_closed(link) for link in trusted] == [True] * 2 + [False] * 10
    assert len(room) == 10 < WAITING_MAX
