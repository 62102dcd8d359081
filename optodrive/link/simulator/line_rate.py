"""The byte rate of a simulated serial line."""

BITS_PER_BYTE = 10
BURST_BYTES = 64
READ_MAX = 4096


class LineRate:
    """Token bucket for the byte rate of a serial line."""

    def __init__(self, baud: int) -> None:
        self._bytes_per_s = baud / BITS_PER_BYTE
        self._tokens = float(BURST_BYTES)
        self._updated_s = 0.0

    def available_bytes(self, now_s: float) -> int:
        """Return how many bytes may pass at now_s."""
        # A late iteration may catch up with what the line would have carried, up to one whole read.
        self._tokens = min(READ_MAX, self._tokens + (now_s - self._updated_s) * self._bytes_per_s)
        self._updated_s = now_s
        return int(self._tokens)

    def consume(self, count: int) -> None:
        """Subtract bytes that passed."""
        self._tokens -= count

    def cap_credit(self) -> None:
        """Discard credit beyond a burst: an idle line does not accumulate it."""
        self._tokens = min(self._tokens, BURST_BYTES)
