"""Synchronisation with the board's clock by the narrowest of the recent exchanges.

Every exchange brackets a board tick between its request and its reply.
"""

import secrets

SAMPLES_MAX = 16
PENDING_MAX = 64
DRIFT_MAX = 2e-4
"""Maximum relative drift of two crystals. A bracket widens at this rate with age."""


class ClockSync:
    """Map from host time to board time (ticks / tick_hz). One thread adds samples, any thread may read."""

    def __init__(self) -> None:
        self._request_s: dict[int, float] = {}
        # An immutable tuple, because another thread may be reading it.
        self._samples: tuple[tuple[float, float, float], ...] = ()

    def start_exchange(self, request_s: float) -> int:
        """Record a request sent at request_s and return its random stamp."""
        if len(self._request_s) > PENDING_MAX:
            self._request_s.clear()
        stamp = secrets.randbits(32)
        self._request_s[stamp] = request_s
        return stamp

    def finish_exchange(self, stamp: int, reply_s: float, board_s: float) -> None:
        """Add the sample of a reply received at reply_s. Ignore an unknown stamp. board_s: board clock in the reply."""
        request_s = self._request_s.pop(stamp, None)
        if request_s is None:
            return
        sample = (reply_s - request_s, (request_s + reply_s) / 2, board_s)
        self._samples = (*self._samples[1 - SAMPLES_MAX :], sample)

    @property
    def is_synchronised(self) -> bool:
        """Whether at least one exchange has completed."""
        return bool(self._samples)

    @property
    def round_trip_s(self) -> float | None:
        """Shortest round trip of the recent samples, s, None without any."""
        return min((sample[0] for sample in self._samples), default=None)

    def find_best_sample(self, host_s: float) -> tuple[float, float] | None:
        """Return host time and board time, s, of the narrowest exchange as of host_s; None before the first."""
        samples = self._samples
        if not samples:
            return None
        best = min(samples, key=lambda sample: sample[0] + DRIFT_MAX * (host_s - sample[1]))
        return best[1:]

    def board_s(self, host_s: float) -> float:
        """Return the board time at host time host_s, s, or 0 before the first exchange."""
        sample = self.find_best_sample(host_s)
        if sample is None:
            return 0.0
        midpoint_s, board_s = sample
        return board_s + (host_s - midpoint_s)
