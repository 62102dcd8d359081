"""The web server, which leaves signals and the process's end to the daemon."""

import asyncio
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import uvicorn


class Server(uvicorn.Server):
    """Leaves signals to `run`: uvicorn would raise them again and end the process before the board is told."""

    on_ready: Callable[[], None] = staticmethod(lambda: None)
    loop: asyncio.AbstractEventLoop | None = None

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to answer."""
        await super().startup(sockets)
        self.loop = asyncio.get_running_loop()
        self.on_ready()
