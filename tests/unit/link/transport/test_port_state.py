import os
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

from optodrive.link.transport.port_state import (
    PortHolder,
    PortState,
    list_serial_ports,
    read_port_state,
    resolve_device,
)


@pytest.fixture
def tmp_path():
    """A folder that nobody else closes: pytest's own are for its user alone."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


NOBODY = 65534


@pytest.fixture
def tty(tmp_path):
    """A pseudo-terminal under a name of its own, as the simulated board makes one."""
    master, slave = os.openpty()
    path = tmp_path / "tty"
    path.symlink_to(os.ttyname(slave))
    os.close(slave)
    yield path
    os.close(master)


@contextmanager
def as_nobody():
    """Root may do anything: be somebody who may not."""
    was = os.geteuid()
    if was == 0:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(was)


def test_a_port_that_is_there_and_one_that_is_gone(tty):
    assert read_port_state(str(tty)) == PortState("there")
    assert resolve_device(str(tty)).startswith("/dev/pts/")
    assert read_port_state(f"{tty}2").status == "gone"
    assert read_port_state("simulated board, virtual time") == PortState("no file")


def test_a_port_without_permission(tty):
    device = resolve_device(str(tty))
    mode = Path(device).stat().st_mode
    Path(device).chmod(0o000)
    try:
        with as_nobody():
            assert read_port_state(str(tty)).status == "denied"
    finally:
        Path(device).chmod(mode)


def test_a_port_that_another_process_holds(tty):
    code = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code, tty], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        state = read_port_state(str(tty))
        process.stdin.close()
    assert state.status == "held"
    (holder,) = state.holders
    assert holder.pid == process.pid
    assert str(process.pid) in str(holder)
    assert read_port_state(str(tty)).status == "there"


def test_a_tree_of_files_stands_for_the_system(tmp_path):
    for folder in ("dev/serial/by-id", "proc/77/fd", "proc/78"):
        (tmp_path / folder).mkdir(parents=True)
    for name in ("ttyUSB1", "ttyACM0"):
        (tmp_path / "dev" / name).touch()
    (tmp_path / "dev/serial/by-id/usb-board").symlink_to("../../ttyACM0")
    (tmp_path / "proc/77/fd/4").symlink_to("/dev/ttyACM0")
    (tmp_path / "proc/77/comm").write_text("minicom\n")
    assert list_serial_ports(tmp_path) == ("/dev/ttyACM0", "/dev/ttyUSB1")
    held = PortState("held", (PortHolder(77, "minicom"),))
    assert read_port_state("/dev/serial/by-id/usb-board", tmp_path) == held
    assert read_port_state("/dev/ttyACM0", tmp_path) == held
    assert read_port_state("/dev/ttyACM1", tmp_path) == PortState("gone", (), ("/dev/ttyACM0", "/dev/ttyUSB1"))


def test_a_port_in_a_folder_that_may_not_be_looked_into(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o700)
    with as_nobody():
        assert read_port_state(str(closed / "tty")).status == "denied"
