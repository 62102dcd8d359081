"""The real link process on a board process: size, start, streaming, and every path into the dark."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from link_process_rig import LinkProcess
from optodrive.core.errors import LinkError
from optodrive.link.protocol.states import BoardState
from optodrive.link.service.link_connection import stop_board
from rig import PATIENT_LEASE_S, wait_for
from wire_points import build_stage_points

FORBIDDEN = ("numba", "pydantic", "fastapi", "uvicorn", "scipy")
OWN_MAX_BYTES = 22 << 20
"""Memory without the pages of files: how many of those are resident is up to the kernel."""
DUTY = 1000


@pytest.fixture
def make_link(tmp_path):
    links = []

    def make(port, **options):
        links.append(LinkProcess(tmp_path, port, **options))
        return links[-1]

    yield make
    for link in links:
        link.stop()


@pytest.fixture
def link(make_link, board):
    """A link process with planner and web, connected to the board."""
    link = make_link(board.port, lease_s=PATIENT_LEASE_S)
    link.open_planner()
    link.web = link.open_client("web")
    link.until(lambda: link.planner.connected)
    return link


def arm(link):
    result = link.await_result(link.web, "arm")
    assert result["error"] is None, result
    link.until(lambda: link.planner.is_ready)


def begin(link, points, **options):
    return link.planner.begin(points, link.planner.board_s() + 0.05, link.planner.epoch, **options)


def emit(link, board, count=5000):
    """Arm and start a plan of seconds. Return when pulses are emitted."""
    arm(link)
    begin(link, build_stage_points(count, DUTY))
    pulses = len(board.of("pulse"))
    link.until(lambda: link.planner.board.state == BoardState.RUNNING and len(board.of("pulse")) > pulses + 10)


def read_state(board):
    return board.of("state")[-1]["state"]


def await_dark(board):
    """Wait until the board has left its armed states, and check the gate's last edge."""
    wait_for(lambda: read_state(board) in (BoardState.DISARMED, BoardState.FAULT), "darkness")
    assert not board.of("gate")[-1]["on"]


def test_it_stays_small(link, board):
    emit(link, board, 2000)
    rollup = Path(f"/proc/{link.process.pid}/smaps_rollup").read_text()
    own_bytes = int(re.search(r"^Anonymous:\s+(\d+) kB", rollup, re.M)[1]) << 10
    print(f"link process: {own_bytes / (1 << 20):.1f} MiB")
    assert own_bytes <= OWN_MAX_BYTES
    maps = Path(f"/proc/{link.process.pid}/maps").read_text()
    assert "numpy" in maps
    assert not re.search("/(llvmlite|numba|pydantic_core|scipy)/", maps)


def test_it_imports_no_heavy_package():
    code = f"import sys, optodrive.link.service.process; print([name for name in {FORBIDDEN} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_an_operator_is_told_when_there_is_no_board(make_link, tmp_path):
    link = make_link(tmp_path / "absent")
    with pytest.raises(LinkError, match="a serial port that exists"):
        link_error_after_retry(link)


def link_error_after_retry(link):
    wait_for(lambda: _try_stop(link) != "the board is not reached yet", "the first attempt")
    return stop_board(link.path)


def _try_stop(link):
    try:
        stop_board(link.path)
    except LinkError as error:
        return str(error)
    return ""


def test_no_socket_is_no_stop(tmp_path):
    assert stop_board(tmp_path / "link.sock") is None


def test_a_signal_stops(link, board):
    emit(link, board)
    epoch = link.planner.epoch
    link.process.send_signal(signal.SIGUSR1)
    link.until(lambda: link.planner.epoch == epoch + 1)
    await_dark(board)
    assert link.planner.epoch_reason == "ended by SIGUSR1"
    assert link.process.poll() is None


def test_sigterm_ends_it_dark(link, board):
    emit(link, board)
    link.process.send_signal(signal.SIGTERM)
    assert link.process.wait() == 0
    await_dark(board)
    assert not link.path.exists()
    wait_for(
        lambda: link.planner.connection.receive() or not link.planner.connection.is_open, "the end of the connection"
    )
    assert (link.planner.connected, link.planner.epoch) == (False, 0)
    assert "has ended" in link.planner.link_error


def test_the_terminals_signals_are_the_supervisors_business(link):
    for number in (signal.SIGINT, signal.SIGHUP):
        link.process.send_signal(number)
    assert link.await_result(link.web, "stop")["error"] is None
    assert link.process.poll() is None


def test_it_beats_while_it_waits_for_an_absent_board_and_finds_it(make_link, make_board, tmp_path):
    link = make_link(tmp_path / "tty")
    planner = link.open_planner()
    link.until(lambda: planner.link_error_code == "no_port")
    assert "tty" in planner.link_error
    kinds = [link.receive_report()["kind"] for _ in range(5)]
    assert kinds == ["beat"] * 5
    make_board()
    link.until(lambda: planner.connected)
    assert planner.link_error is None
    assert planner.pop_clock_shift() is None


def test_a_second_link_process_continues_the_epochs_and_the_capture(make_link, board, tmp_path):
    capture = tmp_path / "link.cap"
    first = make_link(board.port, capture_path=capture)
    first.open_planner()
    first.until(lambda: first.planner.connected)
    epoch = first.planner.epoch
    first.stop()
    second = make_link(board.port, capture_path=capture)
    second.open_planner()
    second.until(lambda: second.planner.connected)
    assert second.planner.epoch > epoch
    assert (tmp_path / "link-2.cap").stat().st_size > 0


def test_many_idle_operators_keep_nobody_from_stopping(link, board):
    emit(link, board)
    idle = [link.open_client("operator") for _ in range(80)]
    assert stop_board(link.path)["board"]["state"] == BoardState.DISARMED
    assert link.planner.connection.is_open
    assert idle


def test_foreign_bytes_close_only_their_connection(link, board):
    emit(link, board)
    client = link.open_client("operator")
    os.write(client.fileno(), b"GET / HTTP/1.1\r\n\r\n" * 100)
    link.until(lambda: client.is_closed)
    assert link.planner.board.state == BoardState.RUNNING
    assert stop_board(link.path)
