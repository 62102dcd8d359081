"""A server of BrlAPI on real sockets: one client at a time, and who keeps the place."""

import select
import socket
import struct

import pytest

from optodrive.client.brlapi import CellPage
from optodrive.client.reader_port import FIRST_PORT, HOST, SocketChannel
from optodrive.core.errors import InputError

KEY = b"key"
GREETING = struct.pack(">III", 4, ord("v"), 8)
PROOF = struct.pack(">III", 4, ord("v"), 8) + struct.pack(">III", 7, ord("a"), ord("K")) + KEY


class Server:
    """A channel of one cell that is served by steps."""

    def __init__(self):
        with socket.create_server((HOST, 0)) as free:
            self.number = free.getsockname()[1] - FIRST_PORT
        self.page = CellPage(1, 1, KEY)
        self.channel = SocketChannel(self.number, self.page)
        self.clients = []

    def connect(self):
        self.clients.append(socket.create_connection((HOST, FIRST_PORT + self.number)))
        self.serve()
        return self.clients[-1]

    def serve(self):
        """Serve what has arrived, as the port does."""
        select.select(self.channel.list_descriptors(), [], [])
        while True:
            data = self.channel.receive()
            if data is None:
                self.page.clear()
            else:
                self.channel.send(self.page.receive(data))
            if not select.select(self.channel.list_descriptors(), [], [], 0.0)[0]:
                return

    def stop(self):
        for client in self.clients:
            client.close()
        self.channel.close()


@pytest.fixture
def server():
    server = Server()
    yield server
    server.stop()


def prove(server, client):
    client.sendall(PROOF)
    while not server.page.has_reader:
        server.serve()


def test_a_client_that_has_proved_its_right_keeps_the_place(server):
    first = server.connect()
    assert first.recv(100) == GREETING
    prove(server, first)
    assert server.connect().recv(100) == b""
    assert server.page.has_reader


def test_a_client_that_has_proved_nothing_gives_way_to_the_next(server):
    silent = server.connect()
    assert silent.recv(100) == GREETING
    other = server.connect()
    assert silent.recv(100) == b""
    assert other.recv(100) == GREETING
    prove(server, other)


def test_the_right_of_a_client_ends_with_its_connection(server):
    first = server.connect()
    prove(server, first)
    first.close()
    server.serve()
    assert not server.page.has_reader
    assert server.connect().recv(100) == GREETING
    assert not server.page.has_reader


def test_a_number_that_is_taken_is_one_line(server):
    with pytest.raises(InputError) as raised:
        SocketChannel(server.number, server.page)
    assert str(raised.value) == f"PORT: got {server.number}, expected the number of a server whose port is free"
