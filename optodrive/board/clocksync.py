"""Board time on the host's clock: each exchange brackets a tick, the narrowest bracket of the last few counts."""

from collections import deque

SAMPLES = 16
DRIFT_MAX = 2e-4
"""Two crystals disagree by less than this; a bracket widens by it as it ages."""


class ClockSync:
    """Maps host seconds to board seconds (ticks over tick_hz)."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float, float]] = deque(maxlen=SAMPLES)

    def add(self, sent_s: float, received_s: float, board_s: float) -> None:
        """Note an exchange: asked at sent_s, answered at received_s, the board read board_s in between."""
        self._samples.append((received_s - sent_s, (sent_s + received_s) / 2, board_s))

    @property
    def known(self) -> bool:
        """Whether there was an exchange yet."""
        return bool(self._samples)

    @property
    def round_trip_s(self) -> float | None:
        """The shortest round trip among the samples, s."""
        return min((sample[0] for sample in self._samples), default=None)

    def board_s(self, host_s: float) -> float:
        """The board's time at host_s, s; 0 before any exchange."""
        if not self._samples:
            return 0.0
        _, middle_s, board_s = min(self._samples, key=lambda sample: sample[0] + DRIFT_MAX * (host_s - sample[1]))
        return board_s + (host_s - middle_s)
