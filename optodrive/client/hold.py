"""Arming that lasts as long as this process: it holds a connection and sends beats."""

import asyncio
import threading
from contextlib import AsyncExitStack, ExitStack, suppress
from types import TracebackType
from typing import Self

from websockets.exceptions import ConnectionClosed

from optodrive.client.endpoint import Endpoint
from optodrive.client.problems import build_error
from optodrive.client.socket_connection import open_async_connection, open_connection
from optodrive.core.errors import NotReadyError, OptodriveError
from optodrive.daemon.responses.hold import HoldReport

HOLD_PATH = "/v1/hold"
BEAT = "beat"
BEAT_INTERVAL_S = 0.25
"""The daemon waits four times as long for the next beat."""
SILENCE_MAX_S = 2.5
"""Longest silence of the daemon; after it nobody can tell whether the board is armed."""
CONNECTION_LOST = "the connection to the daemon was lost"


class HoldState:
    """State of the arming as the daemon has reported it.

    reason: cause of its end, '' while it lasts
    """

    def __init__(self) -> None:
        self.is_armed = False
        self.reason = ""
        self.error: OptodriveError | None = None

    def take(self, text: str | bytes) -> None:
        """Take one message of the daemon."""
        report = HoldReport.model_validate_json(text, extra="ignore")
        self.is_armed = report.status == "armed"
        if report.status == "refused" and report.problem is not None:
            self.error = build_error(report.problem)
        elif report.status == "ended":
            self.end(report.reason or "")

    def end(self, reason: str) -> None:
        """Record the end of the arming, unless it is known."""
        self.is_armed = False
        self.reason = self.reason or reason
        self.error = self.error or NotReadyError(f"the board is no longer held armed: {self.reason}")


class Hold:
    """Arming of the board that ends, dark, with this object's `close`, or with the process.

    Building it arms the board; raise NotReadyError or BoardFaultError if that is refused. A thread sends the beats.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self._state = HoldState()
        self._changed = threading.Condition()
        self._exit_stack = ExitStack()
        self._connection = open_connection(endpoint, HOLD_PATH, self._exit_stack, SILENCE_MAX_S)
        threading.Thread(target=self._run, name="hold", daemon=True).start()
        with self._changed:
            self._changed.wait_for(lambda: self._state.is_armed or self._state.error is not None)
        if self._state.error is not None:
            self.close()
            raise self._state.error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def reason(self) -> str:
        """Cause of the end of the arming, '' while it lasts."""
        return self._state.reason

    def wait(self) -> str:
        """Wait until the arming ends, and return the reason."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._state.reason))
        return self._state.reason

    def close(self) -> None:
        """Let go: the daemon disarms the board."""
        self._exit_stack.close()

    def _run(self) -> None:
        reason = CONNECTION_LOST
        try:
            while True:
                with suppress(ConnectionClosed):  # what the daemon has sent before is read first
                    self._connection.send(BEAT)
                with suppress(TimeoutError):
                    self._take(self._connection.recv(timeout=BEAT_INTERVAL_S))
        except ConnectionClosed as closed:
            reason = (closed.rcvd.reason if closed.rcvd is not None else "") or reason
        finally:
            with self._changed:
                self._state.end(reason)
                self._changed.notify_all()

    def _take(self, text: str | bytes) -> None:
        with self._changed:
            self._state.take(text)
            self._changed.notify_all()


class AsyncHold:
    """Arming of the board that ends, dark, with `close`, or with the process. `open` arms.

    A task sends the beats, so that a loop that is blocked for a second lets go, too.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._state = HoldState()
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Arm the board. Raise NotReadyError or BoardFaultError if that is refused."""
        self._task = asyncio.create_task(self._run())
        await self._changed.wait()
        if self._state.error is not None:
            await self.close()
            raise self._state.error

    @property
    def reason(self) -> str:
        """Cause of the end of the arming, '' while it lasts."""
        return self._state.reason

    async def close(self) -> None:
        """Let go: the daemon disarms the board."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _run(self) -> None:
        reason = CONNECTION_LOST
        try:
            async with AsyncExitStack() as stack:
                connection = await open_async_connection(self._endpoint, HOLD_PATH, stack, SILENCE_MAX_S)
                while True:
                    with suppress(ConnectionClosed):
                        await connection.send(BEAT)
                    with suppress(TimeoutError):
                        self._state.take(await asyncio.wait_for(connection.recv(), BEAT_INTERVAL_S))
                        self._changed.set()
        except OptodriveError as error:
            self._state.error = error
        except ConnectionClosed as closed:
            reason = (closed.rcvd.reason if closed.rcvd is not None else "") or reason
        finally:
            self._state.end(reason)
            self._changed.set()
