"""Emulated Ether Dream, written from the published firmware and independent of the driver.

`EtherDreamCore` is the device with its clock and without a network; the process `ether_dream_process.py` gives it one.
`VirtualStream` takes the place of a TCP connection in virtual time.
"""

import struct
from collections import deque

import numpy as np

from dac.sample_log import SampleLog

CLOCK_HZ = 24_000_000
CAPACITY = 1799
RATE_MAX = 100_000
POINT_BYTES = 18
IDLE, PREPARED, PLAYING = 0, 1, 2
READY, ESTOP = 0, 3
UNDERFLOW, STOPPED_BY_ESTOP = 2, 4
LENGTHS = {b"p": 1, b"b": 7, b"u": 7, b"q": 5, b"s": 1, b"\0": 1, b"\xff": 1, b"c": 1, b"?": 1, b"v": 1, b"d": 3}


class HostDeadError(BaseException):
    """The host was killed. None of its actions reach the DAC."""


class EtherDreamCore:
    """The device. Time is in ticks of its clock.

    extra_ticks: how many ticks longer than clock over rate a point lasts
    """

    def __init__(self, extra_ticks=0, revision=0):
        self.now, self.extra_ticks, self.revision = 0, extra_ticks, revision
        self.playback, self.engine, self.engine_flags, self.playback_flags = IDLE, READY, 0, 0
        self.rate, self.count, self.due = 0, 0, 0
        self.buffer, self.fullness, self.rates = deque(), 0, deque()
        self.log = SampleLog()
        self.played, self.starved = 0, 0

    @property
    def now_s(self):
        return self.now / CLOCK_HZ

    # --- time ---

    @property
    def ticks(self):
        return CLOCK_HZ // self.rate + self.extra_ticks

    def advance(self, now):
        while self.playback == PLAYING and self.due <= now:
            if not self.buffer:
                self.now, self.starved = self.due, self.starved + 1
                self._halt(UNDERFLOW)
                break
            block = self.buffer.popleft()
            if block[0, 0] & 0x8000 and self.rates:
                self.rate = self.rates.popleft()
            rate_changes = np.flatnonzero(block[1:, 0] & 0x8000) + 1
            span = min(int(rate_changes[0]) if len(rate_changes) else len(block), (now - self.due) // self.ticks + 1)
            if span < len(block):
                self.buffer.appendleft(block[span:])
            points, self.fullness = block[:span], self.fullness - span
            x, y = ((points[:, axis].astype(np.int16) >> 4).astype(int) + 0x800 & 0xFFF for axis in (1, 2))
            level = (points[:, 3:7] >> 4).max(axis=1) / 4095
            self.log.put(self.due / CLOCK_HZ, self.ticks / CLOCK_HZ, x, y, level)
            self.due, self.count, self.played = self.due + span * self.ticks, self.count + span, self.played + span
        self.now = max(self.now, now)

    def _halt(self, flag=0):
        """Put zero out on all channels and centre the mirrors."""
        self.playback, self.count = IDLE, 0
        self.playback_flags |= flag
        self.log.state(self.now_s, 2048, 2048)

    def lose_link(self):
        """Stop as the Ethernet cable is unplugged."""
        self._estop(32)

    def _estop(self, cause):
        self.engine, self.engine_flags = ESTOP, self.engine_flags | cause
        self._halt(STOPPED_BY_ESTOP)

    # --- commands ---

    def status(self):
        rate = self.rate if self.playback == PLAYING else 0
        return struct.pack(
            "<4B4H2I", 0, self.engine, self.playback, 0, self.engine_flags, self.playback_flags, 0,
            self.fullness, rate, self.count,
        )  # fmt: skip

    def broadcast(self):
        return struct.pack("<6s3HI", b"\x00\x04\xa3\x01\x02\x03", 1, self.revision, CAPACITY, RATE_MAX) + self.status()

    def answer(self, command, code=b"a"):
        return code + command + self.status()

    def run(self, data):
        """Carry out one whole command other than data and return the answer."""
        command = data[:1]
        if command == b"v":
            return b"emulated".ljust(32, b"\0")
        return self.answer(command, self._carry_out(command, data))

    def _carry_out(self, command, data):
        if command == b"p":
            if self.playback != IDLE or self.engine != READY:
                return b"I"
            self.buffer.clear()
            self.rates.clear()
            self.fullness, self.playback, self.playback_flags = 0, PREPARED, 0
        elif command in (b"b", b"u"):
            rate = struct.unpack_from("<I", data, 3)[0]
            if not 0 < rate <= RATE_MAX:
                return b"I"
            self.rate = rate
            if command == b"b" and self.playback == PREPARED:
                self.playback, self.due = PLAYING, self.now + self.ticks
        elif command == b"q":
            if self.playback != IDLE:
                self.rates.append(struct.unpack_from("<I", data, 1)[0])
        elif command == b"s":
            if self.playback == IDLE:
                return b"I"
            self._halt()
        elif command in (b"\0", b"\xff"):
            self._estop(1)
        elif command == b"c":
            self.engine, self.engine_flags = READY, 0
        return b"a"

    def take(self, points):
        """Put points [n, 9] into the buffer. Return whether there was room for them in this state."""
        if self.playback == IDLE or self.fullness + len(points) > CAPACITY:
            return False
        self.buffer.append(points)
        self.fullness += len(points)
        return True


class Connection:
    """One TCP connection to the device: bytes in, answers out."""

    def __init__(self, core):
        self.core, self.partial, self.missing, self.failed = core, b"", 0, False
        self.closed = False

    def hello(self):
        return self.core.answer(b"?")

    def receive(self, data, now):
        """Carry out what has arrived by a tick and return the answers."""
        self.core.advance(now)
        self.partial += data
        answers = b""
        while self.partial and not self.closed:
            if self.missing:
                count = min(self.missing, len(self.partial) // POINT_BYTES)
                if not count:
                    break
                self._take(count)
                if not self.missing:
                    answers += self.core.answer(b"d", b"I" if self.failed else b"a")
                continue
            command = self.partial[:1]
            if command not in LENGTHS:
                self.closed = True
                break
            length = LENGTHS[command]
            if len(self.partial) < length:
                break
            whole, self.partial = self.partial[:length], self.partial[length:]
            if command == b"d":
                self.missing, self.failed = struct.unpack_from("<H", whole, 1)[0], False
                if not self.missing:
                    answers += self.core.answer(b"d")
            else:
                answers += self.core.run(whole)
        return answers

    def _take(self, count):
        data, self.partial = self.partial[: count * POINT_BYTES], self.partial[count * POINT_BYTES :]
        self.missing -= count
        if not self.failed:
            self.failed = not self.core.take(np.frombuffer(data, dtype="<u2").reshape(-1, 9).astype(int))


class VirtualStream:
    """TCP connection in virtual time, in place of a socket.

    dies_at_s: time at which the host is killed; stalls: spans in which nothing gets through; latency_s: of each way
    """

    def __init__(self, clock, latency_s=3e-4, **device):
        self.clock, self.latency_s = clock, latency_s
        self.core = EtherDreamCore(**device)
        self.connection = None
        self.answers = b""
        self.dies_at_s, self.stalls = float("inf"), []
        self.sent = []
        self.timeout_s = 0.0
        self.is_open = False

    def connect(self, address, timeout):
        self._spend(self.latency_s)
        self.connection, self.is_open = Connection(self.core), True
        self.answers = self.connection.hello()
        return self

    def getpeername(self):
        return "127.0.0.1", 7765

    def settimeout(self, timeout_s):
        self.timeout_s = timeout_s

    def close(self):
        self.is_open = False

    def pass_time(self, duration_s):
        """Let time pass without a host."""
        self.clock.sleep(duration_s)
        self.core.advance(round(self.clock.now_s() * CLOCK_HZ))

    def _spend(self, duration_s):
        self.clock.sleep(duration_s)
        if self.clock.now_s() >= self.dies_at_s:
            self.core.advance(round(self.dies_at_s * CLOCK_HZ))
            raise HostDeadError
        self.core.advance(round(self.clock.now_s() * CLOCK_HZ))

    def sendall(self, data):
        assert self.is_open
        self._spend(self.latency_s)
        for from_s, until_s in self.stalls:
            if from_s <= self.clock.now_s() < until_s:
                self._spend(until_s - self.clock.now_s())
        self.sent.append(bytes(data))
        self.answers += self.connection.receive(bytes(data), round(self.clock.now_s() * CLOCK_HZ))

    def recv(self, size):
        assert self.is_open
        if not self.answers:
            if self.connection.closed:
                return b""
            self._spend(self.timeout_s)
            raise TimeoutError("timed out")
        self._spend(self.latency_s)
        data, self.answers = self.answers[:size], self.answers[size:]
        return data
