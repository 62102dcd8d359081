"""Who controls the light and when it may shine: control of the board, epochs between two stops, and pauses.

In a pause the gate is off, the board stays armed, and the queue waits in the planner. An interruption is one that
nobody has requested: a stage was lost.
"""

from typing import Any, NamedTuple

from optodrive.core.clock import Clock

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
        self.number += 1
        self.reason = reason

    def is_current(self, number: int) -> bool:
        """Return whether points that were accepted in an epoch may be handed over: gate 1."""
        return number == self.number


PAUSE_MAX_S = 300.0
"""Longest pause; after it the board is disarmed."""


class Pauses:
    """Pauses of the light since this process started.

    number: of the latest one; began_s: board time of its begin
    """

    def __init__(self, clock: Clock) -> None:
        self.number = 0
        self.began_s = 0.0
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
        self.number += 1
        self.began_s = board_s
        self._since_s = self._clock.now_s()

    def interrupt(self, board_s: float) -> None:
        """Begin an interruption at a board time, s: a pause that ends when all is reported that was executed."""
        self.number += 1
        self.began_s = board_s

    def end(self) -> None:
        """End the pause, if there is one."""
        self._since_s = None

    def permits(self, number: int) -> bool:
        """Return whether points may be handed over that were built after pause `number`.

        Those built before a later pause are not: the planner counts them as dropped, and builds them again.
        """
        return not self.is_paused and number == self.number

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of the status."""
        return {"number": self.number, "began_s": self.began_s, "ends_in_s": self.ends_in_s}
