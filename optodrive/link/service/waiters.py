"""Clients that wait until the board reaches the state that they requested."""

from collections.abc import Iterator
from dataclasses import dataclass

from optodrive.core.errors import BoardFaultError, LinkError, NotReadyError, OptodriveError
from optodrive.link.protocol.states import IDLE_STATES, BoardState
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.board_view import get_fault_hint

TIMEOUT_S = 5.0
AWAITED_STATES = {
    "arm": (BoardState.ARMED,),
    "disarm": (BoardState.DISARMED,),
    "pause": (BoardState.ARMED,),
    "stop": IDLE_STATES,
}
"""States that fulfil each command."""


@dataclass(frozen=True)
class Waiter:
    """Client that waits for the result of a command."""

    client: int
    request_id: int
    command: str
    deadline_s: float


class StateWaiters:
    """Waiting clients. A waiter ends when the board has the state, refuses the command or exceeds the timeout."""

    def __init__(self) -> None:
        self._waiters: list[Waiter] = []

    def add(self, client: int, request_id: int, command: str, now_s: float) -> None:
        """Add a client. command: one of AWAITED_STATES."""
        self._waiters.append(Waiter(client, request_id, command, now_s + TIMEOUT_S))

    def drop_client(self, client: int) -> bool:
        """Forget a client that has left, and return whether it was arming the board."""
        dropped = [waiter for waiter in self._waiters if waiter.client == client]
        self._waiters = [waiter for waiter in self._waiters if waiter.client != client]
        return any(waiter.command == "arm" for waiter in dropped)

    def pop_ended(self) -> list[Waiter]:
        """Remove and return the clients that wait for an armed board, when something has ended the epoch."""
        ended = [waiter for waiter in self._waiters if BoardState.ARMED in AWAITED_STATES[waiter.command]]
        self._waiters = [waiter for waiter in self._waiters if waiter not in ended]
        return ended

    def pop_results(
        self, boards: BoardGroup, refusal: str | None, link_error: str | None, now_s: float
    ) -> Iterator[tuple[Waiter, OptodriveError | None]]:
        """Remove and yield the waiters that have a result. refusal: reason of a refusal since the last call."""
        for waiter in self._waiters.copy():
            error = _find_error(waiter, boards, refusal, link_error, now_s)
            if error is not None or _is_fulfilled(waiter, boards):
                self._waiters.remove(waiter)
                yield waiter, error


def _is_fulfilled(waiter: Waiter, boards: BoardGroup) -> bool:
    # STOP does not wait for the next session's HELLO: the EVENT of the ending one says that the gate is off.
    has_confirmed = boards.is_acknowledged or (waiter.command == "stop" and boards.abort_confirmed)
    if waiter.command in ("stop", "disarm") and not boards.has_lost_ended:
        return False
    return boards.state in AWAITED_STATES[waiter.command] and has_confirmed


def _find_error(
    waiter: Waiter, boards: BoardGroup, refusal: str | None, link_error: str | None, now_s: float
) -> OptodriveError | None:
    if not boards.connected:
        return LinkError(link_error or "no link to the board")
    if refusal is not None:
        return NotReadyError(f"the board refuses to {waiter.command}: {refusal}")
    if boards.state == BoardState.FAULT and waiter.command == "arm":
        return BoardFaultError(f"the board is in FAULT {boards.fault}: {get_fault_hint(boards.fault)}")
    if now_s > waiter.deadline_s:
        return NotReadyError(f"the board did not {waiter.command} within {TIMEOUT_S:g} s: it is {boards.state}")
    return None
