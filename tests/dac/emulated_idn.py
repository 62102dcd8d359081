"""Emulated IDN device, written from the published server OpenIDN and independent of the driver.

`IdnCore` is the device with its clock and without a network. Empty, it holds its last sample until its connection has
been silent for a second: the worst that the protocol permits.
"""

import struct

import numpy as np

from dac.sample_log import SampleLog

LINK_TIMEOUT_S = 1.0
SLICE_POINTS = 210
BUFFER_TARGET_S = 0.040
CLIENT_GROUP = 0x0F


class HostDeadError(BaseException):
    """The host was killed. None of its actions reach the DAC."""


def read_dictionary(tags):
    """Return name and bytes of each field of a sample."""
    fields = []
    for tag in tags:
        if tag == 0x4010:
            fields[-1][1] += 1
        elif tag >> 8 == 0x42:
            fields.append(["xyz"[tag >> 4 & 3], 1])
        elif tag >> 12 == 5:
            fields.append(["intensity" if tag == 0x5C10 else f"colour{len(fields)}", 1])
    return fields


def decode_samples(data, fields):
    """Return codes of 12 bits and level of samples, [n, 3]; without an intensity its pin is at full level."""
    size = sum(width for _, width in fields)
    table = np.frombuffer(data, dtype=np.uint8).reshape(-1, size).astype(int)
    columns, at = {}, 0
    for name, width in fields:
        columns[name] = table[:, at] if width == 1 else table[:, at] << 8 | table[:, at + 1]
        at += width
    x, y = ((columns[axis].astype(np.uint16).astype(np.int16) >> 4).astype(int) + 2048 for axis in "xy")
    pins = [column / 255 for name, column in columns.items() if name not in "xyz"]
    if "intensity" not in columns:
        pins = [np.max(pins, axis=0)]  # a frame of RGB; its intensity pin is not the laser's
    return np.column_stack([x, y, np.max(pins, axis=0)])


class IdnCore:
    """The device. Time is in seconds of its clock.

    regulated: plays slices at OpenIDN's variable speed; otherwise each chunk at `speed` times its duration
    remembers_latest: refuses samples from before the latest end; OpenIDN compares with the end of the last chunk that
    came, also of a late one, so that of two late chunks the second may be played again
    """

    def __init__(self, regulated=True, speed=1.0, slice_points=SLICE_POINTS, remembers_latest=True):
        self.regulated, self.speed, self.slice_points = regulated, speed, slice_points
        self.remembers_latest = remembers_latest
        self.now_s, self.busy_until_s = 0.0, 0.0
        self.client, self.heard_s = None, -1.0
        self.fields, self.next_stamp, self.errors = None, None, 0
        self.waiting, self.queue = [], []
        self.log = SampleLog()
        self.unit, self.host, self.status = b"\x07\x01\x02\x03\x04\x05\x06\x07", b"emulated", 0x01
        self.dropped = 0
        self.speeds, self.backlog_s, self.backlog_max_s = [], 0.0, 0.0
        self.datagrams, self.flags = 0, 0

    # --- time ---

    def advance(self, now_s):
        while True:
            timeout_s = self.heard_s + LINK_TIMEOUT_S if self.client is not None else float("inf")
            if self.queue and max(self.busy_until_s, self.queue[0][0]) <= min(now_s, timeout_s):
                self._play_buffer(max(self.busy_until_s, self.queue[0][0]))
            elif timeout_s <= now_s:
                self._forget(timeout_s)
            else:
                break
        self.now_s = max(self.now_s, now_s)

    def _play_buffer(self, from_s):
        """Play all that has arrived by a time; what arrives meanwhile waits."""
        count = sum(arrived_s <= from_s for arrived_s, _, _ in self.queue)
        buffer, self.queue = self.queue[:count], self.queue[count:]
        if self.regulated:
            error_ms = 1e3 * BUFFER_TARGET_S - len(buffer) * 1e3 * len(buffer[0][2]) * buffer[0][1]
            target = 1.0 + 0.0002 * error_ms**3 / (1e3 * BUFFER_TARGET_S)
            self.speed = min(1.3, max(0.8, (target + 5.0 * self.speed) / 6.0))
        self.speeds.append(self.speed)
        for _, sample_s, samples in buffer:
            period_s = sample_s * self.speed
            self.log.put(from_s, period_s, *samples.T)
            from_s += period_s * len(samples)
        self.busy_until_s = from_s

    def _forget(self, at_s):
        """Close the connection: what waits is dropped, and the outputs are blanked once the last slice has ended."""
        self.client = self.fields = self.next_stamp = None
        self.waiting, self.queue = [], []
        self.log.state(max(at_s, self.busy_until_s))

    # --- packets ---

    def receive(self, data, now_s, source="host"):
        """Take one datagram and return the answers."""
        self.advance(now_s)
        self.datagrams += 1
        if len(data) < 4:
            return []
        command, flags, sequence = struct.unpack_from(">BBH", data)
        body = data[4:]

        def answer(code, payload):
            return [struct.pack(">BBH", code, flags & CLIENT_GROUP, sequence) + payload]

        if command == 0x08:
            return answer(0x09, body)
        if command == 0x10:
            unit = self.unit.ljust(16, b"\0")
            return answer(0x11, struct.pack(">4B16s20s", 40, 1, self.status, 0, unit, self.host))
        if command == 0x12:
            entry = struct.pack(">4B20s", 1, 0x80, 1, 0, b"Main")
            return answer(0x13, struct.pack(">4B", 4, 24, 0, 1) + entry)
        if command in (0x40, 0x41, 0x44, 0x45):
            self.flags = 0
            result = self._take_message(command, body, source)
            return answer(0x47, struct.pack(">BBHHBBI", 12, result, self.flags, 0, 0, 0, 0)) if command & 1 else []
        return []

    def _take_message(self, command, body, source):
        closes = command in (0x44, 0x45)
        if self.client is None:
            if closes and (not body or body[2:4] == b"\xc0\x00"):
                return 0xEB
            self.client = source
        elif source != self.client:
            return 0xEC
        self.heard_s = self.now_s
        if body:
            result = self._read_message(body)
            if result:
                return result
        if closes:
            self.client = self.fields = self.next_stamp = None
        return 0x00

    def _read_message(self, body):
        if len(body) < 8 or struct.unpack_from(">H", body)[0] != len(body):
            return 0xEE
        _, content, stamp = struct.unpack_from(">HHI", body)
        at, kind, closes = 8, content & 0xFF, False
        if kind <= 0xBF and content & 0x4000:
            words, flags = body[8], body[9]
            at += 4 + 4 * words
            closes = bool(flags & 2)
            if words:
                self.fields = read_dictionary(struct.unpack_from(f">{2 * words}H", body, 12))
        if kind in (0x01, 0x02) and not self.fields:
            self.flags = 0x2000
        elif kind in (0x01, 0x02):
            (duration,) = struct.unpack_from(">I", body, at)
            samples = decode_samples(body[at + 4 :], self.fields)
            self._take_chunk(stamp, duration & 0xFFFFFF, samples, kind == 0x01)
        if closes:
            self.fields = self.next_stamp = None
        return 0

    def _take_chunk(self, stamp, duration_us, samples, is_wave):
        if is_wave:
            late = self.next_stamp is not None and stamp < self.next_stamp
            if not (late and self.remembers_latest):
                self.next_stamp = stamp + duration_us
            if late:
                self.dropped += 1
                return
        sample_s = duration_us * 1e-6 / len(samples)
        self.waiting.append(samples)
        pending = np.concatenate(self.waiting)
        whole = len(pending) - len(pending) % self.slice_points if is_wave and self.regulated else len(pending)
        step = self.slice_points if is_wave and self.regulated else max(whole, 1)
        for first in range(0, whole, step):
            self.queue.append((self.now_s, sample_s, pending[first : first + step]))
        self.waiting = [pending[whole:]] if whole < len(pending) else []


class VirtualRadio:
    """UDP in virtual time, in place of a connected socket.

    disturb: maps the number of a datagram and its bytes to the (delay in s, bytes) that reach the device
    """

    def __init__(self, clock, latency_s=3e-4, **device):
        self.clock, self.latency_s = clock, latency_s
        self.core = IdnCore(**device)
        self.dies_at_s = float("inf")
        self.disturb = lambda number, data: [(0.0, data)]
        self.disturb_answer = lambda number, data: [data]
        self.underway, self.answers, self.sent = [], [], []
        self.timeout_s, self.is_open = 0.0, False

    def connect(self, address):
        self.is_open = True
        return self

    def settimeout(self, timeout_s):
        self.timeout_s = timeout_s

    def close(self):
        self.is_open = False

    def pass_time(self, duration_s):
        """Let time pass without a host."""
        self.clock.sleep(duration_s)
        self._deliver(self.clock.now_s())

    def _deliver(self, until_s):
        for item in sorted(self.underway, key=lambda item: item[0]):
            if item[0] <= until_s:
                self.underway.remove(item)
                answers = self.core.receive(item[1], item[0])
                for answer in answers:
                    self.answers += self.disturb_answer(len(self.sent), answer)
        self.core.advance(until_s)

    def _spend(self, duration_s):
        self.clock.sleep(duration_s)
        self._deliver(min(self.clock.now_s(), self.dies_at_s))
        if self.clock.now_s() >= self.dies_at_s:
            raise HostDeadError

    def send(self, data):
        assert self.is_open
        now_s = self.clock.now_s()
        self.sent.append(bytes(data))
        for delay_s, passed in self.disturb(len(self.sent), bytes(data)):
            self.underway.append((now_s + self.latency_s + delay_s, passed))
        self._spend(self.latency_s)

    def recv(self, size):
        assert self.is_open
        if not self.answers:
            self._spend(self.timeout_s)
            if not self.answers:
                raise TimeoutError("timed out")
        self._spend(self.latency_s)
        return self.answers.pop(0)
