import selectors
import socket
import time
from contextlib import ExitStack

import pytest

from optodrive.daemon.server.stop_first_selector import CLIENTS_PER_TURN, StopFirstSelector

CLIENTS = 40
SECRET = b"a-valid-secret-of-a-viewer"
STOP = b"POST /v1/stop HTTP/1.1\r\nAuthorization: Bearer " + SECRET + b"\r\n\r\n"
REFUSED_STOP = STOP.replace(SECRET, b"guessed-by-nobody")


@pytest.fixture
def make_pair():
    with ExitStack() as stack:

        def make():
            pair = socket.socketpair()
            for sock in pair:
                stack.enter_context(sock)
            return pair

        yield make


@pytest.fixture
def selector():
    with StopFirstSelector(lambda head: SECRET in head) as selector:
        yield selector


def add_client(selector, pair, text):
    own, peer = pair
    selector.register(own, selectors.EVENT_READ)
    selector.add_client(own)
    peer.sendall(text)
    return own.fileno()


def select_read(selector):
    return [key.fd for key, _ in selector.select(0) if key.fd]


def test_stop_precedes_all_clients_that_are_ready(selector, make_pair):
    for _ in range(CLIENTS):
        add_client(selector, make_pair(), b"GET /v1/state HTTP/1.1\r\n")
    stop = add_client(selector, make_pair(), STOP)
    ready = select_read(selector)
    assert ready[0] == stop
    assert len(ready) == CLIENTS_PER_TURN
    assert len(select_read(super(StopFirstSelector, selector))) == CLIENTS + 1  # without the bound


def test_a_stop_that_is_not_permitted_takes_no_precedence(selector, make_pair):
    first = [add_client(selector, make_pair(), b"GET /v1/state HTTP/1.1\r\n") for _ in range(CLIENTS_PER_TURN)]
    refused = add_client(selector, make_pair(), REFUSED_STOP)
    turns = [select_read(selector) for _ in range(3)]
    assert turns[0] == first
    assert refused in turns[1]
    assert add_client(selector, make_pair(), STOP) == select_read(selector)[0]


def test_every_client_gets_its_turn_while_all_stay_ready(selector, make_pair):
    filenos = {add_client(selector, make_pair(), b"GET") for _ in range(CLIENTS)}
    turns = [select_read(selector) for _ in range(-(-CLIENTS // CLIENTS_PER_TURN))]
    assert {fd for turn in turns for fd in turn} == filenos
    assert all(len(turn) <= CLIENTS_PER_TURN for turn in turns)


def test_other_descriptors_are_never_deferred(selector, make_pair):
    for _ in range(CLIENTS):
        add_client(selector, make_pair(), b"GET")
    own, peer = make_pair()
    selector.register(own, selectors.EVENT_READ)
    peer.sendall(STOP)
    for _ in range(5):
        assert own.fileno() in select_read(selector)


def test_the_request_stays_in_the_socket_and_a_removed_client_is_forgotten(selector, make_pair):
    pairs = [make_pair() for _ in range(CLIENTS)]
    for pair in pairs:
        add_client(selector, pair, STOP)
    select_read(selector)
    for own, _ in pairs:
        assert own.recv(200) == STOP
        selector.remove_client(own.fileno())
        selector.unregister(own)
    assert select_read(selector) == []


def test_a_deferred_request_arrived_when_it_was_deferred(selector, make_pair):
    filenos = [add_client(selector, make_pair(), b"GET") for _ in range(CLIENTS)]
    begin_s = time.monotonic()
    chosen = select_read(selector)
    read_s = time.monotonic()
    for fileno in filenos:
        arrived_s = selector.pop_arrival_s(fileno)
        if fileno in chosen:
            assert arrived_s >= read_s
        else:
            assert begin_s <= arrived_s <= read_s
        assert selector.pop_arrival_s(fileno) >= read_s  # the next request of the client


def test_a_connection_that_waited_with_a_request_keeps_its_arrival(selector, make_pair):
    own, peer = make_pair()
    peer.sendall(b"GET")
    selector.add_client(own, 123.0)
    assert selector.pop_arrival_s(own.fileno()) == 123.0
