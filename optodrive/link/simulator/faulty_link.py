"""A link that can break down and be repaired: what arrives is dropped, flipped or never read."""

import random


class FaultyLink:
    """Damages bytes on their way; rates are per byte."""

    def __init__(self, seed: int | None = None) -> None:
        self._random = random.Random(seed)
        self.drop_rate = 0.0
        self.flip_rate = 0.0
        self.hung = False

    def inject_fault(self, kind: str, rate: float = 0.0) -> None:
        """`drop_bytes` or `flip_bits` at a rate, or `hang`: nothing passes."""
        if kind == "hang":
            self.hung = True
        elif kind == "drop_bytes":
            self.drop_rate = rate
        elif kind == "flip_bits":
            self.flip_rate = rate
        else:
            raise ValueError(kind)

    def repair(self) -> None:
        """All well again."""
        self.drop_rate = self.flip_rate = 0.0
        self.hung = False

    def transmit(self, data: bytes) -> bytes:
        """What arrives of data."""
        if self.hung:
            return b""
        if not self.drop_rate and not self.flip_rate:
            return data
        received = (byte for byte in data if self._random.random() >= self.drop_rate)
        return bytes(
            byte ^ (1 << self._random.randrange(8)) if self._random.random() < self.flip_rate else byte
            for byte in received
        )
