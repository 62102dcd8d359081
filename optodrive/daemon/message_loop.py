"""Loop of one thread over message connections, and the server that accepts them on a Unix socket."""

import selectors
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from optodrive.core.ipc import IpcClosed, IpcError, Message, MessageSocket
from optodrive.core.unix_listener import open_unix_listener

BACKLOG = 64
CLIENTS_MAX = 16
"""Connections beyond these are closed at once."""
MessageHandler = Callable[[MessageSocket, Message], None]
LossHandler = Callable[[MessageSocket], None]


class _Connection(NamedTuple):
    on_message: MessageHandler
    on_lost: LossHandler


class MessageLoop:
    """Connections and other descriptors that one thread waits for. That thread calls all methods."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()

    def add(self, connection: MessageSocket, on_message: MessageHandler, on_lost: LossHandler) -> None:
        """Serve a connection until it ends. Call on_lost after its end, unless `remove` ended it."""
        self._selector.register(connection, selectors.EVENT_READ, _Connection(on_message, on_lost))

    def remove(self, connection: MessageSocket) -> None:
        """Close a connection."""
        with suppress(KeyError):
            self._selector.unregister(connection)
        connection.close()

    def watch(self, descriptor: Any, on_readable: Callable[[], object]) -> None:
        """Call a function whenever a descriptor is readable."""
        self._selector.register(descriptor, selectors.EVENT_READ, on_readable)

    def unwatch(self, descriptor: Any) -> None:
        """Stop watching a descriptor."""
        self._selector.unregister(descriptor)

    def poll(self, timeout_s: float) -> None:
        """Wait for at most timeout_s, serve the watched descriptors, then process the messages that have arrived."""
        ready = self._selector.select(max(0.0, timeout_s))
        for key, events in sorted(ready, key=lambda item: isinstance(item[0].data, _Connection)):
            if not isinstance(key.data, _Connection):
                key.data()
            elif isinstance(key.fileobj, MessageSocket) and not key.fileobj.is_closed:
                self._serve(key.fileobj, key.data, events)

    def send(self, connection: MessageSocket, message: Message) -> None:
        """Send a message, or nothing to a connection that has ended. A peer that does not read is lost."""
        if connection.is_closed:
            return
        handlers = self._selector.get_key(connection).data
        try:
            connection.send(message)
        except IpcClosed:
            self._lose(connection, handlers)
        else:
            self._update_interest(connection, handlers)

    def close(self) -> None:
        """Close the loop. Its connections are closed by `remove`."""
        self._selector.close()

    def _serve(self, connection: MessageSocket, handlers: _Connection, events: int) -> None:
        try:
            if events & selectors.EVENT_WRITE:
                connection.flush()
                self._update_interest(connection, handlers)
            messages = connection.receive() if events & selectors.EVENT_READ else []
        except IpcError:
            self._lose(connection, handlers)
            return
        for message in messages:
            handlers.on_message(connection, message)

    def _update_interest(self, connection: MessageSocket, handlers: _Connection) -> None:
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if connection.wants_write else 0)
        if self._selector.get_key(connection).events != events:
            self._selector.modify(connection, events, handlers)

    def _lose(self, connection: MessageSocket, handlers: _Connection) -> None:
        self.remove(connection)
        handlers.on_lost(connection)


class MessageServer:
    """Listening socket on a loop, with its clients."""

    def __init__(self, loop: MessageLoop, path: Path, on_message: MessageHandler, on_lost: LossHandler) -> None:
        """Listen on a path, in place of a socket that an ended process left there. Raise InputError if it is in use."""
        self.clients: list[MessageSocket] = []
        self._loop = loop
        self._path = path
        self._on_message = on_message
        self._on_lost = on_lost
        self._listener = open_unix_listener(path, 0o600, BACKLOG, "socket of a process of the daemon")
        self._listener.setblocking(False)
        loop.watch(self._listener, self._accept)

    def broadcast(self, message: Message) -> None:
        """Send a message to all clients."""
        for client in list(self.clients):
            self._loop.send(client, message)

    def close(self) -> None:
        """Close the listening socket and the connections of all clients."""
        for client in self.clients:
            self._loop.remove(client)
        self.clients.clear()
        self._loop.unwatch(self._listener)
        self._listener.close()
        with suppress(OSError):
            self._path.unlink()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        if len(self.clients) >= CLIENTS_MAX:
            connection.close()
            return
        client = MessageSocket(connection)
        self.clients.append(client)
        self._loop.add(client, self._on_message, self._forget)

    def _forget(self, client: MessageSocket) -> None:
        self.clients.remove(client)
        self._on_lost(client)
