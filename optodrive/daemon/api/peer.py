"""Connection of the web process's event loop to another process of the daemon, with reconnection."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path

from optodrive.core.errors import LinkError
from optodrive.core.ipc import IpcError, Message, MessageSocket

RETRY_S = 0.1


class Peer:
    """Connection to one process. The event loop's thread calls everything.

    name: of the process, in messages; drops: whether it is told of requests whose callers have left
    on_connected: called after every connection, to send what the process must know; on_lost: called after its end
    on_message: receives every message, results included
    """

    def __init__(self, name: str, path: Path, drops: bool = True) -> None:
        self.on_connected: Callable[[], None] = lambda: None
        self.on_lost: Callable[[], None] = lambda: None
        self.on_message: Callable[[Message], None] = lambda message: None
        self._name = name
        self._path = path
        self._drops = drops
        self._socket: MessageSocket | None = None
        self._fileno = -1
        self._ids = count(1)
        self._results: dict[int, asyncio.Future[Message]] = {}
        self._retry: asyncio.TimerHandle | None = None

    @property
    def is_connected(self) -> bool:
        """Whether the connection is up."""
        return self._socket is not None

    def start(self) -> None:
        """Connect, and keep connecting until `close`."""
        self._retry = None
        try:
            connection = MessageSocket.connect(self._path)
        except OSError:
            self._retry = asyncio.get_running_loop().call_later(RETRY_S, self.start)
            return
        self._socket, self._fileno = connection, connection.fileno()
        asyncio.get_running_loop().add_reader(self._fileno, self._receive, connection)
        self.on_connected()

    def close(self) -> None:
        """End the connection permanently."""
        if self._retry is not None:
            self._retry.cancel()
        if self._socket is not None:
            self._forget(self._socket)

    def build_loss_error(self) -> LinkError:
        """Build the error of a request to a process that does not run."""
        return LinkError(f"the {self._name} process does not run; it is being restarted, try again in a few seconds")

    def send(self, message: Message) -> None:
        """Send a message, or drop it without a connection."""
        if self._socket is None:
            return
        connection = self._socket
        try:
            connection.send(message)
        except IpcError as error:
            # The request is refused, and the connection stays.
            if not connection.is_closed:  # the message is too large
                raise LinkError(f"{self._name} process: {error}") from None
            self._lose(connection)
        else:
            self._watch_output(connection)

    async def call(self, message: Message) -> Message:
        """Send a request and return its result. A caller that is cancelled drops it. Raise LinkError without a process.

        message: its fields get an `id`
        """
        if self._socket is None:
            raise self.build_loss_error()
        request_id = next(self._ids)
        future: asyncio.Future[Message] = asyncio.get_running_loop().create_future()
        self._results[request_id] = future
        try:
            self.send(message._replace(fields={**message.fields, "id": request_id}))
            return await future
        except asyncio.CancelledError:
            if self._drops:
                self.send(Message("drop", {"id": request_id}))
            raise
        finally:
            # Its result, if it still comes, is for nobody.
            self._results.pop(request_id, None)

    def _receive(self, connection: MessageSocket) -> None:
        try:
            messages = connection.receive()
        except IpcError:
            self._lose(connection)
            return
        for message in messages:
            if message.kind == "result":
                future = self._results.get(message.fields["id"])
                if future is not None and not future.done():
                    future.set_result(message)
            self.on_message(message)

    def _watch_output(self, connection: MessageSocket) -> None:
        if connection.wants_write:
            asyncio.get_running_loop().add_writer(self._fileno, self._flush, connection)

    def _flush(self, connection: MessageSocket) -> None:
        try:
            connection.flush()
        except IpcError:
            self._lose(connection)
            return
        if not connection.wants_write:
            asyncio.get_running_loop().remove_writer(self._fileno)

    def _lose(self, connection: MessageSocket) -> None:
        # A late call for a connection that was replaced.
        if connection is not self._socket:
            return
        self._forget(connection)
        self.on_lost()
        self._retry = asyncio.get_running_loop().call_later(RETRY_S, self.start)

    def _forget(self, connection: MessageSocket) -> None:
        self._socket = None
        loop = asyncio.get_running_loop()
        for remove in (loop.remove_reader, loop.remove_writer):
            with suppress(OSError):  # the connection has closed itself while bytes waited to be sent
                remove(self._fileno)
        connection.close()
        # At once: nobody waits for a process that may take seconds to restart.
        for future in self._results.values():
            if not future.done():
                future.set_exception(self.build_loss_error())
        self._results.clear()
