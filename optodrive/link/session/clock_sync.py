"""Board time on the host's clock: each exchange brackets a tick, the narrowest bracket of the last few counts."""

SAMPLES_MAX = 16
DRIFT_MAX = 2e-4
"""Two crystals disagree by less than this; a bracket widens by it as it ages."""


class ClockSync:
    """Maps host seconds to board seconds (ticks over tick_hz); one thread adds, any may ask."""

    def __init__(self) -> None:
        # Replaced, never changed: another thread may be walking through the samples.
        self._samples: tuple[tuple[float, float, float], ...] = ()

    def add(self, request_s: float, reply_s: float, board_s: float) -> None:
        """Note an exchange: asked at sent_s, answered at received_s, the board read board_s in between."""
        sample = (reply_s - request_s, (request_s + reply_s) / 2, board_s)
        self._samples = (*self._samples[1 - SAMPLES_MAX :], sample)

    @property
    def is_synchronised(self) -> bool:
        """Whether there was an exchange yet."""
        return bool(self._samples)

    @property
    def round_trip_s(self) -> float | None:
        """The shortest round trip among the samples, s."""
        return min((sample[0] for sample in self._samples), default=None)

    def board_s(self, host_s: float) -> float:
        """The board's time at host_s, s; 0 before any exchange."""
        samples = self._samples
        if not samples:
            return 0.0
        _, midpoint_s, board_s = min(samples, key=lambda sample: sample[0] + DRIFT_MAX * (host_s - sample[1]))
        return board_s + (host_s - midpoint_s)
