"""The web server, with signal handling left to the daemon."""

import asyncio
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import uvicorn


class Server(uvicorn.Server):
    """Captures no signals: uvicorn would raise them again and end the process before the board receives ABORT."""

    on_ready: Callable[[], None] = staticmethod(lambda: None)
    loop: asyncio.AbstractEventLoop | None = None

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture no signals."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to accept requests."""
        await super().startup(sockets)
        self.loop = asyncio.get_running_loop()
        self.on_ready()
