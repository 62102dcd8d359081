"""The sockets of the link process's clients."""

import itertools
import os
import select
import socket
import struct
from contextlib import suppress
from pathlib import Path

from optodrive.core.ipc import MESSAGE_MAX_BYTES, IpcError, MessageSocket, encode_message, open_unix_listener
from optodrive.link.service.link_service import LinkService

CLIENTS_MAX = 32
"""Beyond this number, the operator who has been connected longest is dropped: a new one can always stop."""
ACCEPTED_MAX = 8
"""Connections accepted per iteration of the loop."""
BACKLOG = 128
OUT_MAX_BYTES = 8_000_000
OPERATOR_MESSAGE_MAX_BYTES = 4096
_CREDENTIALS = struct.Struct("3i")
"""Process, user and group of a peer."""


class ClientSockets:
    """Listening socket and connected clients."""

    def __init__(self, path: Path, mode: int, service: LinkService) -> None:
        self._path = path
        self._service = service
        self._numbers = itertools.count(1)
        self._sockets: dict[int, MessageSocket] = {}
        self._trusted: set[int] = set()
        self._listener = open_unix_listener(path, mode, BACKLOG, "link socket")
        self._listener.setblocking(False)

    def register(self, poll: select.poll) -> None:
        """Register all descriptors for the loop's next wait."""
        poll.register(self._listener, select.POLLIN)
        for client in self._sockets.values():
            poll.register(client, select.POLLIN | (select.POLLOUT if client.wants_write else 0))

    def process(self, ready: set[int]) -> None:
        """Serve the clients whose descriptors are ready, the planner with its long messages last."""
        ready_numbers = [number for number, client in self._sockets.items() if client.fileno() in ready]
        for number in sorted(ready_numbers, key=lambda number: number == self._service.planner):
            self._serve(number)
        if self._listener.fileno() in ready:
            for _ in range(ACCEPTED_MAX):
                if not self._accept():
                    break

    def _serve(self, number: int) -> None:
        client = self._sockets[number]
        try:
            if client.wants_write:
                client.flush()
            for message in client.receive():
                self._service.on_message(number, message, number in self._trusted)
        except IpcError:
            self._drop(number)

    def _accept(self) -> bool:
        """Accept a client. Return False if none waits."""
        try:
            connection, _ = self._listener.accept()
        except OSError:  # none, it has left, or there is no descriptor
            return False
        if len(self._sockets) >= CLIENTS_MAX:
            self._drop_oldest_operator()
        number, is_trusted = next(self._numbers), _read_user(connection) == os.geteuid()
        if is_trusted:
            self._trusted.add(number)
        max_bytes = MESSAGE_MAX_BYTES if is_trusted else OPERATOR_MESSAGE_MAX_BYTES
        self._sockets[number] = MessageSocket(connection, max_bytes, OUT_MAX_BYTES)
        return True

    def _drop_oldest_operator(self) -> None:
        observers = self._service.list_observers()
        for number in self._sockets:
            if number not in observers:
                self._drop(number)
                return

    def _drop(self, number: int) -> None:
        self._sockets.pop(number).close()
        self._trusted.discard(number)
        self._service.on_client_lost(number)

    def deliver(self) -> None:
        """Send the service's messages. A client that does not read them is dropped."""
        for clients, message in self._service.pop_outgoing():
            data = encode_message(message)
            for number in clients:
                self._send(number, data)

    def _send(self, number: int, data: bytes) -> None:
        client = self._sockets.get(number)
        if client is None:
            return
        try:
            client.send_bytes(data)
        except IpcError:
            self._drop(number)

    def close(self) -> None:
        """Close all connections and remove the socket's path."""
        with suppress(OSError):
            self._path.unlink()
        self._listener.close()
        for client in self._sockets.values():
            client.close()


def _read_user(connection: socket.socket) -> int:
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(credentials)[1])
