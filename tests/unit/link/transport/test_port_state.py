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
    """Folder that other users may enter. pytest's own folders are private."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


NOBODY = 65534


@pytest.fixture
def tty(tmp_path):
    """Pseudo-terminal behind a symbolic link, as the simulated board creates one."""
    master, slave = os.openpty()
    path = tmp_path / "tty"
    path.symlink_to(os.ttyname(slave))
    os.close(slave)
    yield path
    os.close(master)


@contextmanager
def as_nobody():
    """Run as an unprivileged user, because root may open everything."""
    was = os.geteuid()
    if was == 0:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(was)


def test_an_available_and_a_missing_port(tty):
    assert read_port_state(str(tty)) == PortState("available")
    assert resolve_device(str(tty)).startswith("/dev/pts/")
    assert read_port_state(f"{tty}2").status == "missing"
    assert read_port_state("simulated board, virtual time") == PortState("not_a_file")


def test_a_port_without_permission(tty):
    device = resolve_device(str(tty))
    mode = Path(device).stat().st_mode
    Path(device).chmod(0o000)
    try:
        with as_nobody():
            assert read_port_state(str(tty)).status == "denied"
    finally:
        Path(device).chmod(mode)


def test_a_port_in_use_by_another_process(tty):
    code = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code, tty], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        state = read_port_state(str(tty))
        process.stdin.close()
    assert state.status == "in_use"
    (holder,) = state.holders
    assert holder.pid == process.pid
    assert str(process.pid) in str(holder)
    assert read_port_state(str(tty)).status == "available"


def test_a_folder_can_represent_the_root(tmp_path):
    for folder in ("dev/serial/by-id", "proc/77/fd", "proc/78"):
        (tmp_path / folder).mkdir(parents=True)
    for name in ("ttyUSB1", "ttyACM0"):
        (tmp_path / "dev" / name).touch()
    (tmp_path / "dev/serial/by-id/usb-board").symlink_to("../../ttyACM0")
    (tmp_path / "proc/77/fd/4").symlink_to("/dev/ttyACM0")
    (tmp_path / "proc/77/comm").write_text("minicom\n")
    assert list_serial_ports(tmp_path) == ("/dev/ttyACM0", "/dev/ttyUSB1")
    in_use = PortState("in_use", (PortHolder(77, "minicom"),))
    assert read_port_state("/dev/serial/by-id/usb-board", tmp_path) == in_use
    assert read_port_state("/dev/ttyACM0", tmp_path) == in_use
    assert read_port_state("/dev/ttyACM1", tmp_path) == PortState("missing", (), ("/dev/ttyACM0", "/dev/ttyUSB1"))


def test_a_holder_that_calls_itself_a_line_of_the_log_is_shown_in_one_line(tmp_path):
    """Any user's process may: the name is in doctor, in the log and in the cause of a lost link."""
    for folder in ("dev", "proc/77/fd"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "dev/ttyACM0").touch()
    (tmp_path / "proc/77/fd/4").symlink_to("/dev/ttyACM0")
    (tmp_path / "proc/77/comm").write_text("x\nopto:\x1b[2J\n")
    assert str(read_port_state("/dev/ttyACM0", tmp_path).holders[0]) == r"x\nopto:\x1b[2J, process 77"


def test_a_port_in_a_folder_without_access(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o700)
    with as_nobody():
        assert read_port_state(str(closed / "tty")).status == "denied"
