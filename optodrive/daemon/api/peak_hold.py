"""Peak hold of the display events: no reader misses a peak, however seldom it reads."""

from base64 import b64decode, b64encode

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.daemon.responses.telemetry import DisplayEvent

COLUMNS = ("height_peak", "absorber_peak")


def decode_peaks(event: DisplayEvent) -> IntArray:
    """Return the peaks [2, p] of a display event, of COLUMNS in their units."""
    return np.stack([np.frombuffer(b64decode(getattr(event, name)), dtype="<u2") for name in COLUMNS]).astype(np.int64)


class PeakHold:
    """Highest peaks of every pixel over the display events since the one that a reader received last."""

    def __init__(self) -> None:
        self._peaks: IntArray | None = None
        self._count = 0

    def add(self, peaks: IntArray) -> None:
        """Add the peaks [2, p] of a new event."""
        self._peaks = peaks if self._peaks is None else np.maximum(self._peaks, peaks)
        self._count += 1

    def release(self, newest: DisplayEvent) -> DisplayEvent:
        """Return the newest event with the peaks of all that were added, unchanged if it is alone. Begin anew."""
        peaks, count = self._peaks, self._count
        self._peaks, self._count = None, 0
        if peaks is None or count == 1:
            return newest
        columns = zip(COLUMNS, peaks.astype("<u2"), strict=True)
        return newest.model_copy(update={name: b64encode(column.tobytes()).decode() for name, column in columns})
