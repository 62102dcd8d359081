"""Loop of one thread over message connections, and the server that accepts them on a Unix socket."""

import os
import select
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, Protocol, TypeVar

from optodrive.core.errors import OptodriveError
from optodrive.core.ipc import IpcClosed, IpcError, Message, MessageSocket, open_unix_listener

BACKLOG = 64
CLIENTS_MAX = 16
"""Connections beyond these are closed at once."""
MessageHandler = Callable[[MessageSocket, Message], None]
LossHandler = Callable[[MessageSocket], None]


class Watched(Protocol):
    """An object with a descriptor that a loop can wait for."""

    def fileno(self) -> int:
        """Return the descriptor, negative while there is none."""


class _Handlers(NamedTuple):
    on_message: MessageHandler
    on_lost: LossHandler


class MessageLoop:
    """Connections and other descriptors that one thread waits for. That thread calls all methods.

    Each wait asks anew for the descriptors: one may be closed, and given to another connection, between two waits.
    """

    def __init__(self) -> None:
        self._connections: dict[MessageSocket, _Handlers] = {}
        self._watched: dict[Watched, Callable[[], object]] = {}

    def add(self, connection: MessageSocket, on_message: MessageHandler, on_lost: LossHandler) -> None:
        """Serve a connection until it ends. Call on_lost after its end, unless `remove` ended it."""
        self._connections[connection] = _Handlers(on_message, on_lost)

    def remove(self, connection: MessageSocket) -> None:
        """Close a connection."""
        self._connections.pop(connection, None)
        connection.close()

    def watch(self, watched: Watched, on_ready: Callable[[], object]) -> None:
        """Call a function whenever a descriptor is readable, or writable if it `wants_write`."""
        self._watched[watched] = on_ready

    def unwatch(self, watched: Watched) -> None:
        """Stop watching."""
        del self._watched[watched]

    def poll(self, timeout_s: float) -> None:
        """Wait for at most timeout_s, serve the watched descriptors, then process the messages that have arrived."""
        poll = select.poll()
        for each in (*self._watched, *self._connections):
            if each.fileno() >= 0:
                poll.register(each, select.POLLIN | (select.POLLOUT if getattr(each, "wants_write", False) else 0))
        ready = {descriptor for descriptor, _ in poll.poll(max(0.0, timeout_s) * 1e3)}
        for watched, on_ready in list(self._watched.items()):
            if watched.fileno() in ready:
                on_ready()
        for connection, handlers in list(self._connections.items()):
            if connection.fileno() in ready:
                self._serve(connection, handlers)

    def send(self, connection: MessageSocket, message: Message) -> None:
        """Send a message, or nothing to a connection that has ended. A peer that does not read is lost."""
        if connection.is_closed:
            return
        try:
            connection.send(message)
        except IpcClosed:
            self._lose(connection)

    def _serve(self, connection: MessageSocket, handlers: _Handlers) -> None:
        try:
            if connection.wants_write:
                connection.flush()
            messages = connection.receive()
        except IpcError:
            self._lose(connection)
            return
        for message in messages:
            handlers.on_message(connection, message)

    def _lose(self, connection: MessageSocket) -> None:
        handlers = self._connections[connection]
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


T = TypeVar("T")


def uncancellable_future() -> "Future[Any]":
    """Return a future that its consumers cannot cancel.

    A consumer that gives up must not cancel the engine's pending operation.
    """
    future: Future[Any] = Future()
    future.set_running_or_notify_cancel()
    return future


class LoopCommands:
    """Queue of commands. Any thread posts, the loop runs them."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """Return the descriptor that is readable while commands may wait."""
        return self._event

    def post(self, command: Callable[[], None]) -> None:
        """Queue a command that handles its own errors. Do nothing after close()."""
        self._queue.put(command)
        with suppress(OSError):
            os.eventfd_write(self._event, 1)

    def submit(self, action: Callable[[], T]) -> "Future[T]":
        """Queue an action and return the future of its result."""
        future: Future[T] = uncancellable_future()

        def run_action() -> None:
            try:
                future.set_result(action())
            except OptodriveError as error:
                future.set_exception(error)

        self.post(run_action)
        return future

    def run_pending(self) -> None:
        """Run all queued commands."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._event)
        while True:
            try:
                command = self._queue.get_nowait()
            except Empty:
                return
            command()

    def close(self) -> None:
        """Close the descriptor. Commands that are posted later never run."""
        event, self._event = self._event, -1
        os.close(event)
