"""Arming that lasts as long as this process: it holds a connection and sends beats."""

import asyncio
from contextlib import AsyncExitStack, suppress
from typing import Self

from websockets.exceptions import ConnectionClosed

from optodrive.client.exchange import Endpoint
from optodrive.client.problems import build_error
from optodrive.client.sockets import BlockingConnection, open_connection
from optodrive.core.errors import NotReadyError, OptodriveError
from optodrive.daemon.responses.messages import HoldReport

HOLD_PATH = "/v1/hold"
BEAT = "beat"
BEAT_INTERVAL_S = 0.25
"""The daemon waits four times as long for the next beat."""
SILENCE_MAX_S = 2.5
"""Longest silence of the daemon; after it nobody can tell whether the board is armed."""
CONNECTION_LOST = "the connection to the daemon was lost"


class AsyncHold:
    """Arming of the board that ends, dark, with `close`, or with the process. Entering it arms.

    A task sends the beats, so that a loop that is blocked for a second lets go, too.

    reason: cause of its end, '' while it lasts
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self.reason = ""
        self._endpoint = endpoint
        self._is_armed = False
        self._error: OptodriveError | None = None
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Arm the board. Raise NotReadyError or BoardFaultError if that is refused."""
        self._task = asyncio.create_task(self._run())
        while not self._is_armed and self._error is None:
            await self._wait_for_change()
        if self._error is not None:
            await self.close()
            raise self._error
        return self

    async def wait(self) -> str:
        """Wait until the arming ends, and return the reason."""
        while not self.reason:
            await self._wait_for_change()
        return self.reason

    async def close(self) -> None:
        """Let go: the daemon disarms the board."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def _wait_for_change(self) -> None:
        self._changed.clear()
        await self._changed.wait()

    async def _run(self) -> None:
        reason = CONNECTION_LOST
        try:
            async with AsyncExitStack() as stack:
                connection = await open_connection(self._endpoint, HOLD_PATH, stack, SILENCE_MAX_S)
                while True:
                    with suppress(ConnectionClosed):  # what the daemon has sent before is read first
                        await connection.send(BEAT)
                    with suppress(TimeoutError):
                        self._take(await asyncio.wait_for(connection.recv(), BEAT_INTERVAL_S))
        except OptodriveError as error:
            self._error = error
        except ConnectionClosed as closed:
            reason = (closed.rcvd.reason if closed.rcvd is not None else "") or reason
        finally:
            self._end(reason)

    def _take(self, text: str | bytes) -> None:
        """Take one message of the daemon."""
        report = HoldReport.model_validate_json(text, extra="ignore")
        self._is_armed = report.status == "armed"
        if report.status == "refused" and report.problem is not None:
            self._error = build_error(report.problem)
        elif report.status == "ended":
            self._end(report.reason or "")
        self._changed.set()

    def _end(self, reason: str) -> None:
        """Record the end of the arming, unless it is known."""
        self._is_armed = False
        self.reason = self.reason or reason
        self._error = self._error or NotReadyError(f"the board is no longer held armed: {self.reason}")
        self._changed.set()


class Hold(BlockingConnection[AsyncHold]):
    """Arming of the board that ends, dark, with this object's `close`, or with the process.

    Building it arms the board; raise NotReadyError or BoardFaultError if that is refused. A thread sends the beats.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(AsyncHold(endpoint), "hold")

    @property
    def reason(self) -> str:
        """Cause of the end of the arming, '' while it lasts."""
        return self._connection.reason

    def wait(self) -> str:
        """Wait until the arming ends, and return the reason."""
        return self._loop.run(self._connection.wait())
