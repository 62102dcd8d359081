"""Futures of callers that wait for a state of the board."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from optodrive.core.errors import BoardFaultError, LinkError, NotReadyError, OptodriveError
from optodrive.daemon.responses.state import StateReport
from optodrive.link.protocol.states import BoardState
from optodrive.link.session.fault_hints import get_fault_hint
from optodrive.link.session.session import BoardSession

TIMEOUT_S = 5.0


def uncancellable_future() -> "Future[Any]":
    """Return a future that its consumers cannot cancel.

    A client that times out must not cancel the engine's pending operation.
    """
    future: Future[Any] = Future()
    future.set_running_or_notify_cancel()
    return future


@dataclass
class _Waiter:
    states: tuple[str, ...]
    command: str
    deadline_s: float
    future: "Future[StateReport]"


class StateWaiters:
    """Futures that resolve when the board reaches a requested state, refuses the command or exceeds the timeout."""

    def __init__(self) -> None:
        self._waiters: list[_Waiter] = []

    def __bool__(self) -> bool:
        return bool(self._waiters)

    def add(self, states: tuple[str, ...], command: str, now_s: float, future: "Future[StateReport]") -> None:
        """Add a future for one of `states`. command: name of the command in error messages."""
        self._waiters.append(_Waiter(states, command, now_s + TIMEOUT_S, future))

    def resolve(
        self,
        session: BoardSession,
        refusal: str | None,
        link_error: str | None,
        now_s: float,
        get_snapshot: Callable[[], StateReport],
    ) -> None:
        """Resolve the futures that have an outcome. refusal: reason of a refusal since the last call."""
        for waiter in list(self._waiters):
            error = self._find_error(waiter, session, refusal, link_error, now_s)
            if error is not None:
                waiter.future.set_exception(error)
            elif session.board.state in waiter.states and (
                session.is_acknowledged or (waiter.command == "stop" and session.abort_confirmed)
            ):
                waiter.future.set_result(get_snapshot())
            if waiter.future.done():
                self._waiters.remove(waiter)

    def _find_error(
        self, waiter: _Waiter, session: BoardSession, refusal: str | None, link_error: str | None, now_s: float
    ) -> OptodriveError | None:
        board = session.board
        if not session.connected:
            return LinkError(link_error or "no link to the board")
        if refusal is not None:
            return NotReadyError(f"the board refuses to {waiter.command}: {refusal}")
        if board.state == BoardState.FAULT and waiter.command == "arm":
            return BoardFaultError(f"the board is in FAULT {board.fault}: {get_fault_hint(board.fault)}")
        if now_s > waiter.deadline_s:
            return NotReadyError(f"the board did not {waiter.command} within {TIMEOUT_S:g} s: it is {board.state}")
        return None
