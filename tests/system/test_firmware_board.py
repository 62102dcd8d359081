"""The firmware core as a process, with the tests of the simulated board and a daemon on its port."""

import subprocess

import pytest

import test_board_process as simulated
from firmware_ports import build_board
from rig import long_train, wait_for
from test_board_process import *  # noqa: F403

del test_bad_options_are_one_line_and_status_2  # noqa: F821 - replaced below
# This port's time is its own: kept from the processor, it is a board whose lease is over.
del test_a_descheduled_process_keeps_board_time  # noqa: F821


@pytest.fixture(scope="session")
def program(tmp_path_factory):
    return build_board(tmp_path_factory.mktemp("board"))


@pytest.fixture(autouse=True)
def _start_the_firmware(monkeypatch, program):
    def start(*arguments, **options):
        return subprocess.Popen([*program, *map(str, arguments)], stderr=subprocess.PIPE, text=True, **options)

    monkeypatch.setattr(simulated, "start", start)


@pytest.fixture
def board(make_board, program):
    return make_board(program=program)


@pytest.fixture(name="make_board")
def make_firmware_board(make_board, program):
    return lambda **options: make_board(**{"program": program, **options})


@pytest.mark.parametrize(
    ("option", "text", "says"),
    [
        ("--limits", "max_on = 1", "max_on_us"),
        ("--limits", "cell_codes = 0", "cell_codes: got 0, expected a whole number from 1 to 65535"),
        ("--limits", "=", "line 1: got =, expected valid TOML"),
        ("--limits", "uid = 7", "24 hexadecimal digits"),
        ("--limits", "rest_us = 1\nrest_us = 2", "line 2"),
        ("--limits", "key_edge = 1", "true or false"),
        ("--limits", None, "a readable file"),
        ("--script", '[[step]]\nat_s = 1\nset = "door"', "interlock, key, estop"),
        ("--script", '[[step]]\ndo = "reset"', "at_s"),
        ("--script", '[[step]]\nat_s = 1\ndo = "reset"\nhow = 1', "got how"),
        ("--script", '[[step]]\nat_s = 1\ndo = "reset"\nfrom = "light"', "start or signal"),
        ("--script", '[[step]]\nat_s = 1\ndo = "reset"\nfrom = "signal"', "got at_s"),
        ("--script", "at_s = 1", "nothing but [[step]]"),
        ("--script", None, "a readable file"),
        ("--log", None, "--log"),
        ("--pty", None, "--pty"),
        ("--pty", "a file that is no link", "free"),
        ("--baud", "0", "at least 300"),
        ("--colour", "red", "--exit-when-closed"),
    ],
)
def test_bad_options(tmp_path, program, option, text, says):
    path = tmp_path / ("there.toml" if text else "no/such/file")
    if text:
        path.write_text(text)
    value = text if option in ("--baud", "--colour") else path
    first = ["--pty", tmp_path / "tty"] if option != "--pty" else []
    ended = subprocess.run([*program, *first, option, value], capture_output=True, text=True)
    assert ended.returncode == 2
    assert ended.stderr.startswith("board: ")
    assert ended.stderr.count("\n") == 1
    assert says in ended.stderr
    assert not (tmp_path / "tty").exists()


def test_a_full_disk_ends_it_with_the_gate_off_and_a_message(make_board, open_host):
    board = make_board(disk_bytes=40_000)
    host = open_host(board).hello().arm()
    host.play(simulated.points(200))
    board.process.wait()
    assert board.process.returncode == 1
    assert "the log cannot be written" in board.process.stderr.read()
    assert not board.port.is_symlink()


def test_the_watchdog_resets_a_stopped_main_loop(make_board, open_host):
    board = make_board(script='[[step]]\nat_s = 3.5\ndo = "stop_loop"\n', limits="lease_ms = 2000\n")
    host = open_host(board).hello().arm()
    host.play(simulated.points(600, on_us=8000))
    wait_for(lambda: board.of("state")[-1]["reason"] == "boot" and len(board.of("state")) > 1, "the reset")
    assert 3_550_000 <= board.of("state")[-1]["t_us"] <= 3_551_000
    assert not board.of("gate")[-1]["on"]
    host.heard.clear()
    assert host.hello().of(simulated.m.HelloReply)[-1].reset_cause == 3


# --- with a daemon --------------------------------------------------------------------------------------------------


def test_a_daemon_plays_on_it_and_every_pulse_is_logged(board, make_daemon):
    daemon = make_daemon(board)
    daemon.arm()
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=1.0))["plan"]
    answer = daemon.finished(plan)
    assert answer["status"] == "done", answer
    pulses = board.of("pulse")
    assert answer["executed"] == len(pulses) == len({entry["index"] for entry in pulses}) == 50
    assert all(entry["off_us"] - entry["on_us"] == 10_000 for entry in pulses)
    edges = [(entry["t_us"], entry["on"]) for entry in board.of("gate")]
    assert edges == [edge for entry in pulses for edge in ((entry["on_us"], True), (entry["off_us"], False))]
    assert not board.of("fault")
