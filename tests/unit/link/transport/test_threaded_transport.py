"""A transport that is read in a thread: bytes, failures, closing, and a driver that blocks."""

import os
import select
import threading
import tty
from contextlib import suppress

import pytest

from optodrive.core.errors import InputError, LinkError
from optodrive.link.transport import serial_port
from optodrive.link.transport.serial_port import SerialPort
from optodrive.link.transport.threaded_transport import ThreadedTransport


class Terminal:
    """Pseudo-terminal with the transport on its one end."""

    def __init__(self):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.port = ThreadedTransport(SerialPort(os.ttyname(slave), 1_000_000))
        self.port.open()
        os.close(slave)

    def hang_up(self):
        if self.master >= 0:
            os.close(self.master)
            self.master = -1


@pytest.fixture
def terminal():
    terminal = Terminal()
    yield terminal
    terminal.port.release()
    terminal.hang_up()


def read_all(port, count):
    data = b""
    while len(data) < count:
        data += port.read(0.1)
    return data


def test_bytes_pass_in_both_directions_and_in_order(terminal):
    sent = os.urandom(3000)
    for k in range(0, len(sent), 100):
        os.write(terminal.master, sent[k : k + 100])
    assert read_all(terminal.port, len(sent)) == sent
    terminal.port.write(sent[:1000])
    received = b""
    while len(received) < 1000:
        received += os.read(terminal.master, 1000)
    assert received == sent[:1000]


def test_the_descriptor_tells_when_bytes_have_arrived(terminal):
    assert not select.select([terminal.port.fileno()], [], [], 0.0)[0]
    assert terminal.port.read(0.0) == b""
    os.write(terminal.master, b"x")
    assert select.select([terminal.port.fileno()], [], [])[0]
    assert terminal.port.read(0.0) == b"x"
    assert not select.select([terminal.port.fileno()], [], [], 0.0)[0]


def test_a_hang_up_is_reported_after_the_last_bytes(terminal):
    os.write(terminal.master, b"last")
    assert read_all(terminal.port, 4) == b"last"
    terminal.hang_up()
    assert select.select([terminal.port.fileno()], [], [])[0]
    with pytest.raises(LinkError, match="lost"):
        terminal.port.read(0.0)
    terminal.port.close()
    assert terminal.port.fileno() is None


def test_it_can_be_closed_and_opened_again(terminal):
    for _ in range(3):
        terminal.port.close()
        assert terminal.port.fileno() is None
        assert terminal.port.read(0.0) == b""
        terminal.port.open()  # exclusive: fails unless the earlier one is closed
        os.write(terminal.master, b"again")
        assert read_all(terminal.port, 5) == b"again"


def fill(port):
    """Write more than a terminal has room for, and return it."""
    data = os.urandom(100_000)
    port.write(data)
    return data


def test_a_device_that_accepts_nothing_is_a_lost_link(terminal):
    fill(terminal.port)
    assert "accepts no bytes" in terminal.port.describe_fault()

    def go_on():
        while True:
            terminal.port.write(b"")

    with pytest.raises(LinkError, match="lost: the device accepts no bytes"):
        go_on()


def test_a_device_that_accepts_nothing_holds_up_no_other_one(terminal, monkeypatch):
    other = Terminal()
    monkeypatch.setattr(serial_port.time, "sleep", lambda wait_s: pytest.fail("the caller of both waits"))
    sent = fill(terminal.port)
    try:
        for k in range(10):
            terminal.port.write(bytes([k]))
            other.port.write(bytes([k]))
            assert os.read(other.master, 100) == bytes([k])
        received = b""
        while len(received) < len(sent) + 10:
            terminal.port.write(b"")
            received += os.read(terminal.master, 1_000_000)
        assert received == sent + bytes(range(10))
        assert terminal.port.describe_fault() == ""
    finally:
        monkeypatch.undo()
        other.port.release()
        other.hang_up()


def test_what_waits_is_sent_before_the_permanent_close_and_dropped_by_another(terminal):
    for leave in (terminal.port.close, terminal.port.release):
        sent, received = fill(terminal.port), b""
        leaving = threading.Thread(target=leave)
        leaving.start()
        with suppress(OSError):  # the port is closed
            while True:
                received += os.read(terminal.master, 1_000_000)
        leaving.join()
        assert (received == sent) == (leave == terminal.port.release)
        if leave == terminal.port.close:
            terminal.port.open()


def test_a_missing_port_is_an_input_error(tmp_path):
    port = ThreadedTransport(SerialPort(str(tmp_path / "absent"), 1_000_000))
    with pytest.raises(InputError, match="a serial port that exists"):
        port.open()
    assert port.fileno() is None
    port.release()


class BlockingDriver:
    """Transport whose read waits in the driver, regardless of its timeout."""

    name = "driver"

    def __init__(self):
        self.let_go, self.closed = threading.Event(), threading.Event()

    def open(self):
        pass

    def read(self, timeout_s):
        self.let_go.wait()
        return b"late"

    def write(self, data):
        pass

    def close(self):
        self.closed.set()

    def release(self):
        self.close()


def test_a_driver_that_blocks_does_not_block_the_caller():
    driver = BlockingDriver()
    port = ThreadedTransport(driver)
    port.open()
    assert port.read(0.0) == b""
    port.write(b"abort")
    port.close()
    assert not driver.closed.is_set()  # not under the read
    driver.let_go.set()
    assert driver.closed.wait()
    port.release()
