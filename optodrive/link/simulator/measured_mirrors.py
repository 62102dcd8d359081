"""The positions that a simulated board measures: those of simulated galvos, or of mirrors that follow at once."""

from collections.abc import Callable

from optodrive.core.types.arrays import FloatArray

MIRROR_FAULTS = ("stick_mirror", "slow_mirror", "unplug_mirror")
"""Faults of mirror x: it stays where it is, arrives SLOW_US after a move, or its position output is disconnected."""
SLOW_US = 20_000
DISCONNECTED_CODE = 72_000.0
"""Reading of an input that its pull-up holds at the end of the converter's range, beyond every position."""
POWER_UP = (32768.0, 32768.0)

MirrorSource = Callable[[int], "tuple[float, float] | FloatArray"]
"""Returns the codes of x and y at which the mirrors are, at a time in µs."""


class MeasuredMirrors:
    """Two measured mirrors. source: where they are, None for mirrors that follow at once."""

    def __init__(self, source: MirrorSource | None = None) -> None:
        self._source = source
        self._fault, self._stuck_code = "", 0.0
        self._before = self._target = POWER_UP
        self._moved_us = 0

    def move_to(self, x: int, y: int, at_us: int) -> None:
        """Command both mirrors to codes at a time."""
        self._before, self._target, self._moved_us = self._target, (float(x), float(y)), at_us

    def inject_fault(self, fault: str, at_us: int) -> None:
        """Break mirror x in one of MIRROR_FAULTS, or repair it: ''."""
        self._before = self.read(at_us)  # a slow mirror is so from its next move on
        self._stuck_code, self._fault = self._before[0], fault

    def read(self, at_us: int) -> tuple[float, float]:
        """Return the measured codes of x and y."""
        x, y = self._target if self._source is None else self._source(at_us)
        if self._fault == "stick_mirror":
            x = self._stuck_code
        elif self._fault == "slow_mirror" and at_us < self._moved_us + SLOW_US:
            x = self._before[0]
        elif self._fault == "unplug_mirror":
            x = DISCONNECTED_CODE
        return float(x), float(y)
