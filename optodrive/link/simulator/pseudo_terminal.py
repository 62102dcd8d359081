"""A pseudo-terminal in place of a serial port, under a stable name."""

import os
import random
import tty
from pathlib import Path

from optodrive.core.errors import InputError


def check_link_path(option: str, link: Path) -> None:
    """Raise InputError, naming the option, if the link cannot be created."""
    if not link.parent.is_dir():
        raise InputError(option, str(link), "a name in a folder that exists")
    if link.exists() and not link.is_symlink():
        raise InputError(option, str(link), "a name that is free, or a link")


def open_pty(link: Path) -> int:
    """Open a pty and return the descriptor of its instrument end, non-blocking. link: name that the host opens."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    temporary = link.with_name(link.name + ".new")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(os.ttyname(slave))
    temporary.replace(link)
    os.close(slave)  # from now on a hang-up means that no host has the port open
    return master


def remove_link(link: Path, terminal: Path) -> None:
    """Remove a link that open_pty() has created, unless another instrument has its name by now."""
    if link.is_symlink() and link.readlink() == terminal:
        link.unlink()


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
