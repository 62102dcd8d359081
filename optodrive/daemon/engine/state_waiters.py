"""Callers that wait for the board to reach a state."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from optodrive.core.errors import BoardFaultError, LinkError, NotReadyError, OptodriveError
from optodrive.link.session.fault_hints import hint
from optodrive.link.session.session import Session

Answer = dict[str, Any]
TIMEOUT_S = 5.0


def promise() -> "Future[Any]":
    """A future that whoever waits for it cannot cancel: a caller that gives up must not stop whoever keeps the word."""
    future: Future[Any] = Future()
    future.set_running_or_notify_cancel()
    return future


@dataclass
class _Wait:
    states: tuple[str, ...]
    what: str
    until_s: float
    future: "Future[Answer]"


class Waits:
    """Futures that end when the board is in one of the states asked for, refuses, or takes too long."""

    def __init__(self) -> None:
        self._waits: list[_Wait] = []

    def __bool__(self) -> bool:
        return bool(self._waits)

    def add(self, states: tuple[str, ...], what: str, now_s: float, future: "Future[Answer]") -> None:
        """Let a future wait. what: the order, as the error names it."""
        self._waits.append(_Wait(states, what, now_s + TIMEOUT_S, future))

    def settle(
        self, session: Session, refusal: str | None, link_error: str | None, now_s: float, answer: Callable[[], Answer]
    ) -> None:
        """End the waits that are over. refusal: what the board refused since the last look."""
        for wait in list(self._waits):
            error = self._error(wait, session, refusal, link_error, now_s)
            if error is not None:
                wait.future.set_exception(error)
            elif session.board.state in wait.states and (session.quiet or (wait.what == "stop" and session.aborted)):
                wait.future.set_result(answer())
            if wait.future.done():
                self._waits.remove(wait)

    def _error(
        self, wait: _Wait, session: Session, refusal: str | None, link_error: str | None, now_s: float
    ) -> OptodriveError | None:
        board = session.board
        if not session.connected:
            return LinkError(link_error or "no link to the board")
        if refusal is not None:
            return NotReadyError(f"the board refuses to {wait.what}: {refusal}")
        if board.state == "FAULT" and wait.what == "arm":
            return BoardFaultError(f"the board is in FAULT {board.fault}: {hint(board.fault)}")
        if now_s > wait.until_s:
            return NotReadyError(f"the board did not {wait.what} within {TIMEOUT_S:g} s: it is {board.state}")
        return None
