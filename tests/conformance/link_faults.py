"""Seeded, logged fault injection for one direction of a link, and a check of the pulses that a board may emit."""

import random
from collections import Counter, deque
from typing import NamedTuple

from wire_format import HOST, POINT, uncobs

DAMAGE = ("drop", "flip", "truncate", "lose a byte", "insert a byte")
OLD_FRAMES = 600
"""More than the 256 after which sequence numbers repeat."""
PAUSE_MAX_S = 0.3


class LinkFaults:
    """Injects faults into transmitted frames, reproducible for equal seeds, bytes and times.

    loss: share of lost or damaged frames; extra: probability of additional data before a frame, repeatedly;
    pauses: probability of an interruption after a frame, with delay or loss
    never_again: frame types that are not replayed: an old ABORT correctly ends any session
    """

    def __init__(self, seed, loss=0.0, extra=0.0, pauses=0.0):
        self._random = random.Random(seed)
        self.damage = DAMAGE
        self.never_again = ()
        self.loss, self.extra, self.pauses = loss, extra, pauses
        self.counts = Counter()
        self.log = []
        self.frames = 0
        self._old = deque(maxlen=OLD_FRAMES)
        self._rest = b""
        self._held = b""
        self._until_s = 0.0
        self._lossy_pause = False

    def carry(self, data, now_s):
        """Return the bytes that arrive now, of those sent now or delayed."""
        *pieces, self._rest = (self._rest + data).split(b"\0")
        out = b"".join(self._fate(piece + b"\0", now_s) for piece in pieces if piece)
        if now_s < self._until_s:
            self._held += b"" if self._lossy_pause else out
            return b""
        out, self._held = self._held + out, b""
        return out

    def calm(self):
        """Stop injecting faults."""
        self.loss = self.extra = self.pauses = 0.0
        self._until_s = 0.0

    def _fate(self, frame, now_s):
        self.frames += 1
        out = b""
        while self._random.random() < self.extra:
            out += self._unasked(now_s)
        if frame[1] not in self.never_again:
            self._old.append(frame)
        out += self._damaged(frame, now_s) if self._random.random() < self.loss else frame
        if self._random.random() < self.pauses and now_s >= self._until_s:
            self._lossy_pause = self._random.random() < 0.5
            self._until_s = now_s + self._random.uniform(0.01, PAUSE_MAX_S)
            self._note("half-open" if self._lossy_pause else "stall", now_s)
        return out

    def _unasked(self, now_s):
        kind = self._random.choice(("double", "replay", "shred", "junk"))
        self._note(kind, now_s)
        if kind == "junk" or not self._old:
            return self._random.randbytes(self._random.randrange(1, 30)) + b"\0"
        frame = self._old[-1] if kind == "double" else self._random.choice(self._old)
        return frame[: self._random.randrange(1, len(frame))] + b"\0" if kind == "shred" else frame

    def _damaged(self, frame, now_s):
        kind = self._random.choice(self.damage)
        self._note(kind, now_s)
        at = self._random.randrange(len(frame))
        if kind == "drop":
            return b""
        if kind == "flip":
            return frame[:at] + bytes([frame[at] ^ 1 << self._random.randrange(8)]) + frame[at + 1 :]
        if kind == "truncate":
            return frame[:at]
        return frame[:at] + (frame[at + 1 :] if kind == "lose a byte" else self._random.randbytes(1) + frame[at:])

    def _note(self, kind, now_s):
        self.counts[kind] += 1
        self.log.append((self.frames, kind, now_s))


class Pulse(NamedTuple):
    """An emitting point as the host sent it."""

    index: int
    x: int
    y: int
    duty: int
    on_us: int


class Witness:
    """Compares the host's output, before any fault, with the board's log.

    All points of a run must differ, so that a pulse identifies its point.
    """

    def __init__(self):
        self._rest = b""
        self._sent = {}
        self._done = set()

    def wrote(self, data):
        """Record the host's bytes."""
        *pieces, self._rest = (self._rest + data).split(b"\0")
        for piece in filter(None, pieces):
            raw = uncobs(piece)
            if raw[0] == HOST["DATA"][0]:
                first = int.from_bytes(raw[4:8], "little")
                for k, (x, y, _, on_us, duty) in enumerate(POINT.iter_unpack(raw[8:-4])):
                    if on_us:
                        self._sent[first + k, x, y, duty] = on_us

    def check(self, events):
        """Check that each pulse of the log was sent, is unchanged, once and in order. Return the number of pulses."""
        last_index, count = -1, 0
        ended = {(entry["t_us"], entry["reason"]) for entry in events if entry["event"] == "gate" and not entry["on"]}
        for entry in events:
            if entry["event"] == "state" and entry["reason"] == "armed":
                last_index = -1
            if entry["event"] != "pulse":
                continue
            pulse = tuple(entry[name] for name in ("index", "x", "y", "duty"))
            assert pulse in self._sent, f"never sent: {entry}"
            assert pulse not in self._done, f"twice: {entry}"
            assert entry["index"] > last_index, f"out of order: {entry}"
            gate_on_us = entry["off_us"] - entry["on_us"]
            whole = (entry["off_us"], f"point {entry['index']} done") in ended
            assert gate_on_us == self._sent[pulse] if whole else gate_on_us <= self._sent[pulse], (
                f"another width: {entry}"
            )
            self._done.add(pulse)
            last_index = entry["index"]
            count += 1
        return count
