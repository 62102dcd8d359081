"""Commands that own the board end, in one line, when board, sensor or worker is killed or suspended."""

import signal
import subprocess

import pytest

from forked_process import FULL_INDICATOR, OPTODRIVE, SHORT_INDICATOR, start_process
from optodrive.core.clock import MonotonicClock
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.link_capture import CapturingTransport, LinkCaptureWriter
from optodrive.link.transport.serial_port import SerialPort
from rig import Board, Command, config_text, is_alive, read_proc, wait_for
from sensor_cable import Cable
from signalled_processes import (
    SIGNALS,
    assert_one_line,
    assert_stayed_dark,
    resume,
    signalling,
    wait_for_end,
    wait_until_dark,
)

COMMANDS = {
    "home": ("home", "--spot-power-mw", "5"),
    "calibrate-board": ("calibrate", "board", "--yes", "--out", "field.toml", "--target-rms-um", "0.1"),
    "first-light": ("first-light", "--yes", "--pulses", "5"),
    "calibrate-steps": ("calibrate", "steps", "--out", "steps-out", "--pause", "1"),
    "calibrate-sweep": ("calibrate", "sweep", "--yes", "--out", "sweep-out", "--rest", "1"),
}
SENSING = ("home", "calibrate-board")
PROGRESS = ("optodrive: arming, ", "spot ")
"""Beginnings of the lines on stderr that tell the progress of a calibration."""
STAGES = {
    "home": ("connecting", "arming", "moving", "lighting", "reading", "disarming"),
    "calibrate-board": ("connecting", "arming", "lighting", "reading", "saving"),
    "first-light": ("connecting", "arming", "lighting"),
    "calibrate-steps": ("connecting", "arming", "moving"),
    "calibrate-sweep": ("connecting", "arming", "lighting"),
}
EVERY_TIME = {
    ("home", "board", signal.SIGSTOP, "connecting"),
    ("calibrate-board", "sensor", signal.SIGSTOP, "reading"),
    ("calibrate-board", "worker", signal.SIGSTOP, "saving"),
}


def matrix():
    """Return all cases, command by victim by fault by stage, of which three run every time."""
    cases = []
    for command, stages in STAGES.items():
        victims = ("board", *(["sensor"] if command in SENSING else []))
        for victim in (*victims, *(["worker"] if command == "calibrate-board" else [])):
            for stage in stages:
                if victim == "sensor" and stage == "disarming":  # it is no longer needed
                    continue
                for number in SIGNALS:
                    case = command, victim, number, stage
                    marks = [] if case in EVERY_TIME else [pytest.mark.slow]
                    cases.append(pytest.param(*case, marks=marks, id=f"{command}-{victim}-{number.name}-{stage}"))
    return cases


@pytest.fixture
def bench(tmp_path):
    """Return a function that starts a board, a cable to its sensor and a command on both."""
    started = []

    def start(command):
        indicator = FULL_INDICATOR if command in ("home", "first-light") else SHORT_INDICATOR
        board = Board(tmp_path, program=indicator, sensor=() if command in SENSING else None)
        started.append(board)
        cable = None
        if command in SENSING:
            wait_for(board.sensor.exists, "the sensor's port")
            cable = Cable(board.sensor)
            started.append(cable)
            board.sensor = cable.port
        arguments = [
            tmp_path / each if each in ("field.toml", "steps-out", "sweep-out") else each for each in COMMANDS[command]
        ]
        started.append(Command(tmp_path, board, *arguments))
        return board, cable, started[-1].process

    yield start
    for each in reversed(started):
        each.stop()


def find_worker(process):
    """Return the process id of the worker of a calibration, 0 before it starts."""
    for child in read_proc(process.pid, f"task/{process.pid}/children").split():
        if "spawn_main" in read_proc(child, "cmdline"):
            return int(child)
    return 0


def has_reached(stage, board, folder):
    """Return whether a command has reached a stage, by the board's log and by the command's files."""
    states = {event["state"] for event in board.of("state")}
    if stage == "connecting":
        return any(event["open"] for event in board.of("port"))
    if stage == "arming":
        return "ARMING" in states
    if stage == "moving":
        return "RUNNING" in states
    if stage == "lighting":
        return any(event["on"] for event in board.of("gate"))
    if stage == "reading":  # the sensor is asked after each pulse
        return len(board.of("pulse")) >= 2
    if stage == "saving":
        return (folder / "field.toml.session.json").exists()
    return len(board.of("pulse")) >= 15  # all spots of homing


@pytest.mark.parametrize(("command", "victim", "number", "stage"), matrix())
def test_it_ends_in_one_line(bench, tmp_path, command, victim, number, stage):
    board, cable, process = bench(command)
    with signalling() as send:
        wait_for(lambda: has_reached(stage, board, tmp_path) or process.poll() is not None, stage)
        pid = {
            "board": lambda: board.process.pid,
            "sensor": lambda: cable.process.pid,
            "worker": lambda: find_worker(process),
        }[victim]()
        assert process.poll() is None
        send(number, [pid])
        errors = wait_for_end(process)
        print(f"\n{errors.strip().splitlines()[-1:]}")
        assert process.returncode == 1
        assert_one_line(errors, PROGRESS)
        resume([pid])
        dark = wait_until_dark(board)
        if is_alive(board.process.pid):
            wait_for(lambda: not board.of("port")[-1]["open"], "the end of the connection")
        assert_stayed_dark(board, dark)
    assert not (tmp_path / "field.toml").exists()
    assert victim != "worker" or not is_alive(pid)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Return a capture of eight seconds of a session with a board that stays disarmed."""
    folder = tmp_path_factory.mktemp("capture")
    board = Board(folder)
    try:
        (folder / "bench.toml").write_text(config_text(board.port))
        clock = MonotonicClock()
        writer = LinkCaptureWriter(folder / "capture", clock.now_s(), pytest.fail)
        transport = CapturingTransport(SerialPort(str(board.port), 1_000_000), writer, clock)
        session = BoardSession(transport, clock, build_board_requirements(load_config(folder / "bench.toml")))
        session.connect()
        until_s = clock.now_s() + 8.0
        while clock.now_s() < until_s:
            session.step(0.01, renew_lease=False)
        session.close()
        return writer.path
    finally:
        board.stop()


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_a_replay_to_a_board_ends(tmp_path, capture, number):
    board = Board(tmp_path)
    process = start_process(
        [OPTODRIVE, "wire", "replay", capture, "--board", board.port],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        with signalling() as send:
            wait_for(lambda: has_reached("connecting", board, tmp_path), "connecting")
            send(number, [board.process.pid])
            errors = wait_for_end(process)
            assert process.returncode == 1
            assert_one_line(errors)
    finally:
        board.stop()
