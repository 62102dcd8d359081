"""The arming of one board: requested once, followed by the board's reports, and lost when they contradict it."""

import secrets

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.states import BoardState

_PROGRESS: dict[str, int] = {BoardState.ARMING: 1, BoardState.ARMED: 2, BoardState.RUNNING: 2, BoardState.HOLD: 2}
"""How far the board is in each state; 0 in all others."""


class Arming:
    """The arming that a session has requested. Only while it is present may the board have a lease or points.

    is_present: from the request until end(), or until the board reports that it has left what it had reached
    is_lost: whether the board's reports have ended it, since the last request
    """

    def __init__(self) -> None:
        self.is_present = self.is_lost = False
        self._progress = 0
        self._nonce: int | None = None

    def begin(self) -> m.ArmReq:
        """Begin an arming and return its request."""
        self.is_present, self.is_lost = True, False
        self._progress, self._nonce = 0, secrets.randbits(32)
        return m.ArmReq(host_nonce=self._nonce)

    def end(self) -> None:
        """End the arming. Only begin() brings another."""
        self.is_present = self.is_lost = False
        self._nonce = None

    def confirm(self, challenge: m.ArmChallenge) -> m.ArmConfirm | None:
        """Return the confirmation of the board's challenge, None if it does not answer this arming's request."""
        if self._nonce is None or challenge.host_nonce != self._nonce:
            return None
        self._nonce = None
        return m.ArmConfirm(host_nonce=challenge.host_nonce, board_nonce=challenge.board_nonce)

    def follow(self, state: str) -> None:
        """Take over a state that the board has reported."""
        if not self.is_present:
            return
        progress = _PROGRESS.get(state, 0)
        if progress < self._progress:
            self.end()
            self.is_lost = True
        self._progress = progress
