"""What errors of ports mean in messages, and that a transport leaves nothing behind, also of a device that fails."""

import errno
import gc
import os
import threading
import tty
from pathlib import Path

import pytest

from optodrive.core.errors import InputError, LinkError
from optodrive.link.service.process import PortOpener
from optodrive.link.transport import threaded_transport
from optodrive.link.transport.base import build_lost_error, build_open_error
from optodrive.link.transport.serial_port import SerialPort
from optodrive.link.transport.threaded_transport import ThreadedTransport
from port_fault_rig import NUMBERED, OTHERS

MEANINGS = {
    "EACCES": ("this user may not open it", "join its group"),
    "EPERM": ("the system forbids it to this process", "DeviceAllow"),
    "EBUSY": ("another program has it open", "end that program"),
    "EAGAIN": ("another program has it open", "end that program"),
    "ENXIO": ("no device is behind it", "connect the device, or name another port"),
    "EIO": ("does not answer its driver", "check plug, cable and supply"),
    "ENODEV": ("the device is gone: unplugged, reset or without power", "check plug"),
    "EMFILE": ("this process has too many files open", "LimitNOFILE"),
    "ENFILE": ("this computer has too many files open", "fs.file-max"),
    "ENOTTY": ("it is no serial port", "name a serial port"),
    "EINVAL": ("refuses a setting", "choose a bit rate"),
    "ETIMEDOUT": ("accepts no bytes", "check whether it hangs"),
    "EPROTO": ("a USB transfer failed", "connect it directly"),
    "ENOMEM": ("no memory left", "end other programs"),
}


@pytest.mark.parametrize("name", MEANINGS)
@pytest.mark.parametrize("build", NUMBERED)
def test_each_error_says_in_one_line_what_it_means_and_what_to_do(name, build):
    meaning, remedy = MEANINGS[name]
    for error in (
        build_open_error("/dev/x", build(getattr(errno, name)), "board.port"),
        build_lost_error("/dev/x", build(getattr(errno, name))),
    ):
        message = str(error)
        assert all(part in message for part in ("/dev/x", name, meaning, remedy)), message
        assert message.isprintable()


@pytest.mark.parametrize("build", NUMBERED)
def test_an_absent_or_denied_device_is_invalid_input(build):
    for name in ("ENOENT", "ENOTDIR", "EACCES", "EPERM"):
        error = build_open_error("/dev/x", build(getattr(errno, name)), "board.port")
        assert isinstance(error, InputError)
        assert (error.where, error.code) == ("board.port", "no_port")


@pytest.mark.parametrize("error", OTHERS, ids=lambda error: type(error).__name__)
def test_an_error_without_a_number_is_shown_and_its_cause_is_not_claimed(error):
    error.__context__ = None
    message = str(build_lost_error("/dev/x", error))
    assert type(error).__name__ in message
    assert message.endswith("what causes it is not known")
    assert message.isprintable()


@pytest.fixture
def terminal():
    master, slave = os.openpty()
    tty.setraw(slave)
    yield SerialPort(os.ttyname(slave), 1_000_000)
    os.close(slave)
    os.close(master)


def list_descriptors():
    return {int(path.name) for path in Path("/proc/self/fd").iterdir()}


def test_a_device_whose_closing_fails_leaves_no_descriptor_and_closes_no_other(terminal, monkeypatch):
    before = list_descriptors()
    terminal.open()
    failing, close = terminal.fileno(), os.close

    def close_but_fail(descriptor):
        close(descriptor)
        if descriptor == failing:
            raise OSError(errno.EIO, "gone")

    monkeypatch.setattr(os, "close", close_but_fail)
    terminal.close()
    monkeypatch.undo()
    assert list_descriptors() == before
    other = os.dup2(0, failing)  # another file gets the number
    gc.collect()
    os.fstat(other)
    os.close(other)


def test_a_reader_that_cannot_start_is_a_port_that_cannot_be_opened(terminal, monkeypatch):
    port, before = ThreadedTransport(terminal), list_descriptors()

    def refuse(*arguments):
        raise OSError(errno.EMFILE, "too many")

    monkeypatch.setattr(threaded_transport.os, "eventfd", refuse)
    with pytest.raises(LinkError, match=r"too many files open \(EMFILE\)"):
        port.open()
    monkeypatch.undo()

    def start(thread):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(LinkError, match="can't start new thread"):
        port.open()
    opener = PortOpener(port)
    with pytest.raises(LinkError, match="can't start new thread"):
        opener()
    monkeypatch.undo()
    while not opener():
        pass
    port.close()
    port.release()
    assert list_descriptors() == before
