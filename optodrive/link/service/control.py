"""Control of the board: who armed it, since when, and whether the arming is held."""

from typing import Any, NamedTuple

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
