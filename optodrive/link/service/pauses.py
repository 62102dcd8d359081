"""Pauses: the gate is off, the board stays armed, and the queue waits in the planner.

An interruption is one that nobody has requested: a stage was lost.
"""

from typing import Any

from optodrive.core.clock import Clock

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
