"""Peak hold of the display events: no reader misses a peak, however seldom it reads."""

from base64 import b64decode, b64encode

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.daemon.responses.telemetry import DisplayEvent


def decode_peaks(event: DisplayEvent) -> IntArray:
    """Return the peaks [p] of a display event, in its unit."""
    return np.frombuffer(b64decode(event.peak), dtype="<u2").astype(np.int64)


class PeakHold:
    """Highest peak of every pixel over the display events since the one that a reader received last."""

    def __init__(self) -> None:
        self._peaks: IntArray | None = None

    def add(self, peaks: IntArray) -> None:
        """Add the peaks [p] of a new event."""
        self._peaks = peaks if self._peaks is None else np.maximum(self._peaks, peaks)

    def release(self, newest: DisplayEvent) -> DisplayEvent:
        """Return the newest event with the peaks of all that were added, and begin anew."""
        peaks, self._peaks = self._peaks, None
        if peaks is None:
            return newest
        return newest.model_copy(update={"peak": b64encode(peaks.astype("<u2").tobytes()).decode()})
