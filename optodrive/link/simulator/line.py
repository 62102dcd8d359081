"""The serial line to a simulated board: its byte rate, and faults that a test injects."""

import random


class FaultyLink:
    """Transmits bytes with faults, at rates per byte."""

    def __init__(self, seed: int | None = None) -> None:
        self._random = random.Random(seed)
        self.drop_rate = 0.0
        self.flip_rate = 0.0
        self.hung = False

    def inject_fault(self, kind: str, rate: float = 0.0) -> None:
        """Inject a fault: `drop_bytes` or `flip_bits` at a rate, or `hang`, which loses all bytes."""
        if kind == "hang":
            self.hung = True
        elif kind == "drop_bytes":
            self.drop_rate = rate
        elif kind == "flip_bits":
            self.flip_rate = rate
        else:
            raise ValueError(kind)

    def repair(self) -> None:
        """Remove all faults."""
        self.drop_rate = self.flip_rate = 0.0
        self.hung = False

    def transmit(self, data: bytes) -> bytes:
        """Return the bytes that arrive when data is sent."""
        if self.hung:
            return b""
        if not self.drop_rate and not self.flip_rate:
            return data
        received = (byte for byte in data if self._random.random() >= self.drop_rate)
        return bytes(
            byte ^ (1 << self._random.randrange(8)) if self._random.random() < self.flip_rate else byte
            for byte in received
        )


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
