"""Callers whose token was revoked, with the time of it."""

from math import inf

from optodrive.core.errors import StoppedError


class RevokedCallers:
    """Names of callers with the board time of the last revocation, s. A name may belong to a new token since then."""

    def __init__(self) -> None:
        self._revoked_s: dict[str, float] = {}

    def revoke(self, caller: str, board_s: float) -> str:
        """Record a revocation at a board time, s, and return the reason for people."""
        self._revoked_s[caller] = board_s
        return f"the token {caller!r} was revoked"

    def require_valid(self, caller: str, arrived_s: float) -> None:
        """Raise StoppedError for a request that arrived at a board time, s, before the revocation of its token."""
        if arrived_s <= self._revoked_s.get(caller, -inf):
            raise StoppedError(f"the token {caller!r} was revoked")
