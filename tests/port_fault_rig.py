"""A device that fails in every way its libraries can, below the real serial transport, in virtual time."""

import errno
import os
import struct
import termios
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import serial
import usb.core

from optodrive.link.simulator.board_core import BoardClock
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.link.transport import port_state, serial_port
from optodrive.link.transport.serial_port import SerialPort

NUMBERS = tuple(sorted(set(errno.errorcode) - {errno.EINTR}))
ABSENT = errno.ENOENT, errno.ENOTDIR
FIRST_DESCRIPTOR = 1_000_000
OPENING = ("exists", "open", "settings", "node")
NO_ROOM = "accepts no bytes"
RUNNING = ("timeout", "read", "in_waiting", "rest", "fileno", "write")
"""Calls in which a fault keeps the port closed, or ends its link."""


class Fault(NamedTuple):
    """One failure. shown: text that the message about it must contain."""

    call: str
    error: Exception
    shown: str


def wrap_by_context(number):
    """Return pyserial's error about one of termios, as it raises it: without a number of its own."""
    try:
        try:
            raise termios.error(number, os.strerror(number))
        except termios.error as error:
            raise serial.SerialException(f"Could not configure port: {error}")  # noqa: B904
    except serial.SerialException as error:
        return error


NUMBERED = (
    lambda number: OSError(number, os.strerror(number)),
    lambda number: termios.error(number, os.strerror(number)),
    lambda number: serial.SerialException(number, f"could not open port: {os.strerror(number)}"),
    lambda number: usb.core.USBError(os.strerror(number), -1, number),
    wrap_by_context,
)
OTHERS = (
    termios.error("tcgetattr: elements of attribute must be characters"),
    serial.SerialException("device reports readiness to read but returned no data"),
    serial.SerialTimeoutException("Write timeout"),
    serial.PortNotOpenError(),
    usb.core.NoBackendError("No backend available"),
    usb.core.USBError("Other error", -99, None),
    usb.core.USBTimeoutError("Operation timed out", -7, None),
    OSError("bad"),
    struct.error("unpack requires a buffer of 4 bytes"),
    ValueError("filedescriptor out of range in select()"),
    TypeError("an integer is required (got type NoneType)"),
    AttributeError("'NoneType' object has no attribute 'fd'"),
    RuntimeError("can't start new thread"),
    NotImplementedError("custom baud rate"),
    UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
    IndexError("descriptor"),
    KeyError("transport"),
    AssertionError("interface"),
    EOFError("end"),
    OverflowError("Python int too large to convert to C int"),
    Exception("two\nlines\x1b[2J"),
)


def draw_fault(rng, calls):
    """Draw a failure of one of these calls."""
    call = rng.choice(calls)
    if rng.random() < 0.4:
        error = rng.choice(OTHERS)
        error.__context__ = None  # of an earlier raise
        return Fault(call, error, type(error).__name__)
    number = rng.choice(NUMBERS)
    if call == "write" and number in (errno.EAGAIN, errno.EWOULDBLOCK):  # the transport waits for room
        return Fault(call, OSError(number, "full"), NO_ROOM)
    shown = "exists" if number in ABSENT and call in OPENING else errno.errorcode[number]
    return Fault(call, rng.choice(NUMBERED)(number), shown)


class FaultyPort(SerialPort):
    """The serial port of a simulated board that does not notice its end.

    faults: by call, raised until `repair`; grants: host times at which the board got a longer lease, and its end
    """

    def __init__(self, core, clock, board_clock=None, name="board"):
        super().__init__(f"/dev/{name}", 1_000_000)
        self.board_clock = board_clock or BoardClock()
        self.memory = MemoryLink(core, clock)
        self.memory._now_us = self._now_us
        self.core, self.clock = core, clock
        self.faults, self.raised, self.grants = {}, [], []
        PORTS.pop(self.name, None)
        PORTS[self.name] = self

    def _now_us(self):
        return round(self.board_clock.read_s(self.clock.now_s()) * 1e6)

    def call(self, name):
        fault = self.faults.get(name)
        if fault is not None:
            self.raised.append(fault)
            raise fault.error

    def break_board(self, *faults):
        self.faults |= {fault.call: fault for fault in faults}

    def repair(self):
        self.faults, self.raised = {}, []

    def receive(self, data):
        before_us = self.core.lease_until_us
        self.core.receive(bytes(data), self._now_us())
        if self.core.lease_until_us > before_us:
            self.grants.append((self.clock.now_s(), self.board_clock.find_true_s(self.core.lease_until_us * 1e-6)))


class FaultyDevice:
    """What pyserial's Serial is to the transport."""

    def __init__(self, name, baud, **options):
        self._port = PORTS[name]
        self._port.call("open")
        self._timeout_s, self._buffer = 0.0, b""
        self.is_open, self.fd = True, FIRST_DESCRIPTOR + len(DEVICES)
        DEVICES[self.fd] = self

    def fileno(self):
        self._port.call("fileno" if self._port._node is not None else "settings")
        return self.fd

    @property
    def timeout(self):
        self._port.call("timeout")
        return self._timeout_s

    @timeout.setter
    def timeout(self, timeout_s):
        self._timeout_s = timeout_s

    @property
    def in_waiting(self):
        self._port.call("in_waiting")
        return len(self._buffer)

    def read(self, count):
        self._port.call("rest" if self._buffer else "read")
        if not self._buffer:
            self._buffer = self._port.memory.read(self._timeout_s)
        data, self._buffer = self._buffer[:count], self._buffer[count:]
        return data

    def write(self, data):
        self._port.call("write")
        self._port.receive(data)
        return len(data)

    def close(self):
        self._port.call("close")
        self.is_open = False


PORTS, DEVICES = {}, {}


class FaultyPath(type(Path())):
    """Path of a port whose look-up fails."""

    def exists(self):
        PORTS[str(self)].call("exists")
        return True

    def stat(self, **options):
        PORTS[str(self)].call("stat")
        return SimpleNamespace(st_dev=1, st_ino=2)


def install(monkeypatch):
    """Put the faulty device below the serial transport, whose time is that of the last port."""

    def find_clock():
        return next(reversed(PORTS.values())).clock

    def tcgetattr(descriptor):
        DEVICES[descriptor]._port.call("settings")
        return [0, 0, 0, 0, 15, 15, []]

    def fstat(descriptor):
        DEVICES[descriptor]._port.call("node")
        return SimpleNamespace(st_dev=1, st_ino=2)

    def find_holders(name, root):
        PORTS[name].call("holders")
        return ()

    system = SimpleNamespace(
        write=lambda descriptor, data: DEVICES[descriptor].write(data), fstat=fstat, close=lambda descriptor: None
    )
    timer = SimpleNamespace(monotonic=lambda: find_clock().now_s(), sleep=lambda wait_s: find_clock().sleep(wait_s))
    monkeypatch.setattr(serial_port, "os", system)
    monkeypatch.setattr(serial_port, "time", timer)
    monkeypatch.setattr(serial_port, "termios", SimpleNamespace(tcgetattr=tcgetattr, error=termios.error))
    monkeypatch.setattr(serial_port, "serial", SimpleNamespace(Serial=FaultyDevice))
    monkeypatch.setattr(serial_port, "Path", FaultyPath)
    monkeypatch.setattr(port_state, "find_holders", find_holders)
    monkeypatch.setattr(port_state, "join_root", lambda root, name: FaultyPath(name))
    monkeypatch.setattr(port_state, "os", SimpleNamespace(access=lambda *_, **__: True, R_OK=4, W_OK=2))
