"""Who controls the light and when it may shine.

Clients have roles, one caller has control of the board, epochs lie between two stops, and a pause keeps the board armed
with the gate off, while the queue waits in the planner. An interruption is a pause that nobody has requested: a stage
was lost, or light would have been late.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import Any, NamedTuple

from optodrive.core.clock import Clock
from optodrive.core.errors import BoardFaultError, LinkError, NotReadyError, OptodriveError
from optodrive.core.ipc import IpcError
from optodrive.link.protocol.states import IDLE_STATES, BoardState
from optodrive.link.service.settings import OnWebLoss
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.board_view import get_fault_hint

HOLD_MAX_S = 1.0
"""Longest time between the beats of a client that holds the arming."""


class Control(NamedTuple):
    """One arming.

    caller: name of the token that requested it; requested_s: host time of the request
    arming: number by which the web process refers to it; held_s: host time of the last beat of the client that holds
    it, None if it is not held
    """

    caller: str
    requested_s: float
    arming: int = 0
    held_s: float | None = None

    def record_beat(self, at_s: float) -> "Control":
        """Return the control after a beat at a host time, s, which cannot be earlier than the beat before."""
        # By arrival at the web server: a beat that waited in a queue proves only that the client lived then.
        return self if self.held_s is None else self._replace(held_s=max(self.held_s, at_s))

    def is_abandoned(self, now_s: float) -> bool:
        """Return whether the client that holds the arming has stopped to beat."""
        return self.held_s is not None and now_s - self.held_s > HOLD_MAX_S

    def describe_caller(self) -> str:
        """Return who requested the arming, as the begin of a sentence."""
        return repr(self.caller) if self.caller else "another caller"

    def to_dict(self, now_s: float) -> dict[str, Any]:
        """Return the fields of the status at a host time, s."""
        return {
            "caller": self.caller,
            "armed_for_s": now_s - self.requested_s,
            "hold": self.held_s is not None,
            "arming": self.arming,
        }


STOP, DISARM = "ended by stop", "ended by disarm"
"""Reasons of a caller who wants the light to end, for which a plan is stopped rather than failed."""


class Epoch:
    """The present epoch.

    number: greater than all earlier ones; reason: cause that has ended the one before, for people
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self.reason = "the link process has started"

    def end(self, reason: str) -> None:
        """Begin the next epoch. reason: cause that ends this one, as the end of a sentence."""
        # First the number: a request that is refused from here on is of the epoch before.
        self.number += 1
        self.reason = reason

    def is_current(self, number: int) -> bool:
        """Return whether points that were accepted in an epoch may be handed over: gate 1."""
        return number == self.number


PAUSE_MAX_S = 300.0
"""Longest pause; after it the board is disarmed."""


class PauseStatus(NamedTuple):
    """The latest pause: number, board time of its begin, s, and time until it is too long, None once it has ended."""

    number: int = 0
    began_s: float = 0.0
    ends_in_s: float | None = None


NO_PAUSE = PauseStatus()


class Pauses:
    """Pauses of the light since this process started.

    number: of the latest one; began_s: board time of its begin; reason: for people, '' if it was requested
    """

    def __init__(self, clock: Clock) -> None:
        self.number = 0
        self.began_s = 0.0
        self.reason = ""
        self._clock = clock
        self._since_s: float | None = None

    @property
    def is_paused(self) -> bool:
        """Whether the light is paused."""
        return self._since_s is not None

    @property
    def ends_in_s(self) -> float | None:
        """Time until the pause is too long, s, or None if the light is not paused."""
        return None if self._since_s is None else self._since_s + PAUSE_MAX_S - self._clock.now_s()

    @property
    def is_too_long(self) -> bool:
        """Whether the board is to be disarmed."""
        return self.ends_in_s is not None and self.ends_in_s <= 0.0

    def begin(self, board_s: float) -> None:
        """Begin a pause at a board time, s."""
        self.interrupt(board_s, "")
        self._since_s = self._clock.now_s()

    def interrupt(self, board_s: float, reason: str) -> None:
        """Begin an interruption at a board time, s: a pause that ends when all is reported that was executed."""
        self.number += 1
        self.began_s, self.reason = board_s, reason

    def end(self) -> None:
        """End the pause, if there is one."""
        # The number stays: points built before this pause are refused also after it.
        self._since_s = None

    def permits(self, number: int) -> bool:
        """Return whether points may be handed over that were built after pause `number`.

        Those built before a later pause are not: the planner counts them as dropped, and builds them again.
        """
        return not self.is_paused and number == self.number

    def build_status(self) -> PauseStatus:
        """Return the number of the latest pause, its begin and its end."""
        return PauseStatus(self.number, self.began_s, self.ends_in_s)


BEAT_AGE_MAX_S = 1.0
"""Age of a beat beyond which its sender counts as stalled."""
PERMISSIONS = {
    "planner": {"stop", "beat", "begin", "splice", "extend", "truncate", "flush", "delay"},
    "web": {"stop", "beat", "arm", "disarm", "pause", "resume", "revoke", "hold", "release"},
    "acceptor": {"stop"},
    # No arming: after a restart nobody may be present.
    "supervisor": {"stop", "disarm"},
    "operator": {"stop"},
}
"""Kinds of messages by role. Everyone who may open the socket may stop."""
SINGLE_ROLES = ("planner", "web")
LOSS_REASONS = {"planner": "the planner process has ended", "web": "the web process has ended"}


class Clients:
    """Clients by number. planner: the number of the planner, None without one."""

    def __init__(self, on_web_loss: OnWebLoss, clock: Clock) -> None:
        self._on_web_loss = on_web_loss
        self._clock = clock
        self._roles: dict[int, str] = {}
        self._beats: dict[str, tuple[float, bool]] = {}

    @property
    def planner(self) -> int | None:
        """Number of the planner."""
        return self._find("planner")

    def _find(self, role: str) -> int | None:
        return next((client for client, its_role in self._roles.items() if its_role == role), None)

    def add(self, client: int, role: str, trusted: bool) -> int | None:
        """Add a client, unless another has its role: return that one, which must be removed first.

        Raise IpcError for a role that the client may not have.
        """
        # Once per connection: a client that changed its role could collect the permissions of several.
        if role not in PERMISSIONS or client in self._roles or (role != "operator" and not trusted):
            raise IpcError(f"role: got {role!r}, expected one that this client may have, once")
        # The newer one wins: after a restart the former's socket may not be noticed as closed yet.
        previous = self._find(role) if role in SINGLE_ROLES else None
        if previous is None:
            self._roles[client] = role
        return previous

    def remove(self, client: int) -> str:
        """Remove a client. Return why its loss ends the epoch, '' if it does not."""
        role = self._roles.pop(client, "")
        self._beats.pop(role, None)
        # Then a shell or the key must do; `_end_unattended` bounds how long.
        if role == "web" and self._on_web_loss == "finish":
            return ""
        return LOSS_REASONS.get(role, "")

    def require_permission(self, client: int, kind: str) -> None:
        """Raise IpcError if the client may not send a message of this kind."""
        role = self._roles.get(client)
        if role is None or kind not in PERMISSIONS[role]:
            raise IpcError(f"message {kind!r}: not permitted to {role or 'a client without hello'}")

    def list_observers(self) -> tuple[int, ...]:
        """Return the clients that receive the status: all but operators."""
        return tuple(client for client, role in self._roles.items() if role != "operator")

    def record_beat(self, client: int, alive: bool) -> None:
        """Record that a client's loop runs. alive: whether its work is idle or makes progress."""
        self._beats[self._roles[client]] = self._clock.now_s(), alive

    def find_stalled(self) -> str:
        """Return the role that withholds the lease, '' if it may be renewed."""
        # Beats, not sockets: a process that hangs keeps its socket open.
        roles = ("planner",) if self._on_web_loss == "finish" else ("planner", "web")
        return next((role for role in roles if not self._is_alive(role)), "")

    def _is_alive(self, role: str) -> bool:
        beat_s, alive = self._beats.get(role, (-inf, False))
        return alive and self._clock.now_s() - beat_s <= BEAT_AGE_MAX_S

    @property
    def is_attended(self) -> bool:
        """Whether a web process is there through which a person could disarm."""
        return self._is_alive("web")

    def require_lease(self) -> None:
        """Raise NotReadyError if the lease could not be renewed after arming."""
        stalled = self.find_stalled()
        if stalled:
            raise NotReadyError(f"the {stalled} process does not run or makes no progress; arm when it is ready")


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
