"""The clients of the link process, with their roles and permissions, and whether they permit the lease."""

from math import inf

from optodrive.core.clock import Clock
from optodrive.core.errors import NotReadyError
from optodrive.core.ipc import IpcError
from optodrive.link.service.settings import OnWebLoss

BEAT_AGE_MAX_S = 1.0
"""Age of a beat beyond which its sender counts as stalled."""
PERMISSIONS = {
    "planner": {"stop", "beat", "begin", "splice", "extend", "truncate", "flush", "delay"},
    "web": {"stop", "beat", "arm", "disarm", "pause", "resume", "revoke", "hold", "release"},
    "acceptor": {"stop"},
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
        if role not in PERMISSIONS or client in self._roles or (role != "operator" and not trusted):
            raise IpcError(f"role: got {role!r}, expected one that this client may have, once")
        previous = self._find(role) if role in SINGLE_ROLES else None
        if previous is None:
            self._roles[client] = role
        return previous

    def remove(self, client: int) -> str:
        """Remove a client. Return why its loss ends the epoch, '' if it does not."""
        role = self._roles.pop(client, "")
        self._beats.pop(role, None)
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
