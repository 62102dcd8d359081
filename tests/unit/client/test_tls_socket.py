"""TLS sockets of the blocking client: two threads use one, and OpenSSL is entered with one call at a time."""

import socket
import ssl
import subprocess
import threading
from contextlib import contextmanager, suppress

import pytest

from optodrive.client.tls_socket import build_tls_context

COUNT, SIZE = 300, 40_000


@pytest.fixture
def certificate(tmp_path):
    path, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    names = ("-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost")
    options = ("-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *names, "-keyout", key)
    subprocess.run(["openssl", "req", *options, "-out", path], check=True, capture_output=True)
    return path, key


@contextmanager
def connect_to_echo(certificate):
    """Connect to a server that returns the bytes that it gets."""
    path, key = certificate
    near, far = socket.socketpair()
    server_context, client_context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), build_tls_context()
    server_context.load_cert_chain(path, key)
    client_context.load_verify_locations(path)

    def echo():
        with server_context.wrap_socket(far, server_side=True) as server:
            while data := server.recv(65536):
                server.sendall(data)

    thread = threading.Thread(target=echo)
    thread.start()
    try:
        with client_context.wrap_socket(near, server_hostname="localhost") as client:
            yield client
            with suppress(OSError):  # the test has done it
                client.shutdown(socket.SHUT_RDWR)
    finally:
        thread.join()


def count_overlaps(monkeypatch, client):
    """Send and read back at the same time in two threads; return the number of calls that entered beside another."""
    inside, overlaps, lock = 0, 0, threading.Lock()

    def watch(name):
        original = getattr(ssl.SSLSocket, name)

        def call(self, *arguments):
            nonlocal inside, overlaps
            if self is not client:
                return original(self, *arguments)
            with lock:
                overlaps += inside > 0
                inside += 1
            try:
                return original(self, *arguments)
            finally:
                with lock:
                    inside -= 1

        monkeypatch.setattr(ssl.SSLSocket, name, call)

    for name in ("read", "send"):
        watch(name)
    message, received = bytes(range(250)) * (SIZE // 250), bytearray()

    def read():
        while len(received) < COUNT * SIZE:
            received.extend(client.recv(65536))

    thread = threading.Thread(target=read)
    thread.start()
    for _ in range(COUNT):
        client.sendall(message)
    thread.join()
    assert received == message * COUNT
    return overlaps


def test_no_two_calls_enter_a_connection_at_once(monkeypatch, certificate):
    with connect_to_echo(certificate) as client:
        assert count_overlaps(monkeypatch, client) == 0


def test_a_wait_ends_with_its_timeout(certificate):
    with connect_to_echo(certificate) as client:
        client.settimeout(0.01)
        with pytest.raises(TimeoutError):
            client.recv(1)
        client.settimeout(None)
        client.sendall(b"y")
        assert client.recv(10) == b"y"


def test_a_reader_learns_that_the_socket_was_shut_down(certificate):
    with connect_to_echo(certificate) as client:
        left = []
        thread = threading.Thread(target=lambda: left.append(client.recv(10)))
        thread.start()
        client.shutdown(socket.SHUT_RDWR)
        thread.join()
    assert left == [b""]
