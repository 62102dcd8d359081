"""A link with injectable faults: lost bytes, flipped bits, or no bytes at all."""

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
