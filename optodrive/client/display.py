"""A display, controlled from Python."""

from base64 import b64encode
from collections.abc import Callable, Coroutine
from functools import wraps
from html import escape
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import numpy as np

from optodrive.client.endpoint import Endpoint
from optodrive.client.exchange import run_blocking
from optodrive.client.fingers import Fingers
from optodrive.client.hold import Hold
from optodrive.client.http import BlockingHttp
from optodrive.client.operations import RECONNECT_TIMEOUT_S, DisplayOperations
from optodrive.client.stream import Stream
from optodrive.core.daemon_url import read_default_url
from optodrive.core.errors import OptodriveError
from optodrive.core.types.push_options import Policy
from optodrive.daemon.responses.state import StateReport

P = ParamSpec("P")
T = TypeVar("T")


def _block(
    operation: Callable[Concatenate[DisplayOperations, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate["Display", P], T]:
    """Build the method that blocks until an operation has ended."""

    @wraps(operation)
    def run(display: "Display", /, *arguments: P.args, **options: P.kwargs) -> T:
        return run_blocking(operation(display._operations, *arguments, **options))

    return run


class Display:
    """A display behind a running daemon, as a context manager that stops everything that this client started.

    url: if None, OPTODRIVE_URL, else http://127.0.0.1:8450
    token: if None, OPTODRIVE_TOKEN, else the file that the daemon wrote
    reconnect_timeout_s: how long requests to a daemon that has responded before are repeated if it is unreachable

    Only `arm` arms; a restarted daemon has a DISARMED board. A client that only reads (state, preview, patterns, …)
    stops nothing.
    """

    def __init__(
        self, url: str | None = None, token: str | None = None, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        self._client = BlockingHttp(Endpoint(url or read_default_url(), token))
        self._operations = DisplayOperations(self._client, reconnect_timeout_s)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._hold: Hold | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._operations.may_emit:
                self.stop()
        except OptodriveError as stop_error:
            if error is None:
                raise
            error.add_note(f"optodrive: {stop_error}")  # the block's own exception takes precedence
        finally:
            self.close()

    def close(self) -> None:
        """Close the connections without stopping anything, but for an arming that they hold. Only `stop` works then."""
        if self._hold is not None:
            self._hold.close()
        self._client.close()

    def arm(self, *, hold: bool = False) -> StateReport:
        """Arm the board unless it is armed. Its indicator is on for two seconds first.

        hold: the board disarms, dark, when this display is closed, or when its process ends or stops for a second; a
        board that is armed already is refused. Raises NotReadyError or BoardFaultError.
        """
        if not hold:
            return run_blocking(self._operations.arm())
        self._record_emission()
        self._hold = Hold(self._client.endpoint)
        return self.state()

    disarm = _block(DisplayOperations.disarm)
    dim = _block(DisplayOperations.dim)
    pause = _block(DisplayOperations.pause)
    resume = _block(DisplayOperations.resume)
    stop = _block(DisplayOperations.stop)
    state = _block(DisplayOperations.state)
    config = _block(DisplayOperations.config)
    layout = property(_block(DisplayOperations.layout))
    show = _block(DisplayOperations.show)
    push = _block(DisplayOperations.push)
    play = _block(DisplayOperations.play)
    preview = _block(DisplayOperations.preview)
    patterns = _block(DisplayOperations.patterns)
    plan = _block(DisplayOperations.plan)
    cancel = _block(DisplayOperations.cancel)
    wait = _block(DisplayOperations.wait)

    def stream(self, policy: Policy = "trim", *, standing: bool = False) -> Stream:
        """Open a stream of frames, of which the newest wins: `with display.stream() as stream: stream.send(…)`.

        standing: refresh the newest frame until the next one, under fingers first
        """
        self._client.require_open()
        endpoint, layout = self._client.endpoint, self.layout
        return Stream(endpoint, layout, policy, standing, self._reconnect_timeout_s, self._record_emission)

    def fingers(self) -> Fingers:
        """Open a connection for the places of fingertips, for which frames that stand are refreshed first."""
        return Fingers(self._client.endpoint)

    def _record_emission(self) -> None:
        self._client.require_open()
        self._operations.may_emit = True

    def __repr__(self) -> str:
        return f"<Display at {self._client.endpoint.url}>"

    def _repr_png_(self) -> bytes | None:
        from optodrive.client.picture import render_png

        try:
            layout = self.layout
        except OptodriveError:
            return None
        plan = self._operations.last_plan
        heights_um = None if plan is None else plan.heights_um
        return render_png(layout, np.zeros(len(layout)) if heights_um is None else heights_um)

    def _repr_html_(self) -> str:
        try:
            state = self.state()
        except OptodriveError as error:
            return f"<p>{escape(repr(self))}: {escape(str(error))}</p>"
        board, plan = state.board, self._operations.last_plan
        parts = [state.display, f"{state.pixels} pixels", board.state, f"link {state.link.state}"]
        if board.fault:
            parts.append(f"{board.fault}: {board.hint}")
        caption = "nothing shown yet" if plan is None else repr(plan)
        picture = b64encode(self._repr_png_() or b"").decode()
        return (
            f"<p>{escape(', '.join(parts))}<br>{escape(caption)}</p>"
            f'<img alt="heights of {escape(caption)}" src="data:image/png;base64,{picture}">'
        )
