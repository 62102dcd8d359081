"""`optodrive doctor --board`: a board without a configuration, in virtual time, and never armed."""

import json

import pytest

from c_core import CBoard, build_library
from forked_process import SIMULATED, start_process
from optodrive.cli.doctor_bare_board import check_bare_board
from optodrive.cli.main import run
from optodrive.core.clock import ManualClock
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.states import BoardState
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.board_machine import BoardMachine
from optodrive.link.simulator.guards import BoardSettings
from optodrive.link.simulator.virtual_run import MemoryLink

CHECKS = ["board", "capacities", "limits", "inputs", "clock", "link", "trigger", "lease, stop"]


class DriftingLink(MemoryLink):
    """A link to a board whose clock runs at another rate."""

    rate = 1.0

    def _now_us(self):
        return round(super()._now_us() * self.rate)


class DeadLink(MemoryLink):
    """A link on which nothing answers."""

    def write(self, data):
        pass


def examine(link=MemoryLink, rate=1.0, inputs=(), **settings):
    """Examine a simulated board. Return its findings by check, and its log."""
    log, clock = [], ManualClock(5.0)
    board = BoardCore(BoardSettings(**settings), log.append, seed=1)
    for name, value in inputs:
        board.set_input(name, value, 1000)
    line = link(board, clock)
    line.rate = rate
    findings = check_bare_board(line, clock)
    return {finding.check: finding for finding in findings}, log


def states(log):
    return {entry["state"] for entry in log if entry["event"] == "state"}


def test_a_sound_board_is_described_and_stays_disarmed():
    findings, log = examine(uid="0123456789abcdef01234567", cells=77, window_pulses=99, queue_points=300)
    assert list(findings) == CHECKS
    assert {finding.status for finding in findings.values()} == {"ok"}
    assert "uid 0123456789abcdef01234567" in findings["board"].observation
    assert findings["capacities"].observation.startswith("300 points, 99 pulses a second, 77 cells of ")
    assert states(log) == {"DISARMED"}
    assert not [entry for entry in log if entry["event"] in ("gate", "fault", "rx_error")]


@pytest.mark.parametrize(
    ("rate", "status", "ppm"), [(1 + 1e-4, "ok", 100), (1 - 3e-3, "problem", -3000), (1.01, "problem", 10_000)]
)
def test_the_rate_of_its_clock(rate, status, ppm):
    finding = examine(DriftingLink, rate)[0]["clock"]
    stated, uncertainty = (int(word) for word in finding.observation.split(" ppm")[0].split(" ± "))
    assert finding.status == status
    assert abs(stated - ppm) <= uncertainty < 100


def test_inputs_and_a_fault_are_named():
    findings, _ = examine(inputs=[("interlock", False), ("estop", True)])
    assert findings["inputs"].observation == "the enclosure is open; the emergency stop is pressed"
    assert findings["board"].status == "warning"
    assert "FAULT INTERLOCK" in findings["board"].observation


@pytest.fixture(scope="session")
def library(tmp_path_factory):
    return build_library(tmp_path_factory.mktemp("core"))


@pytest.mark.parametrize(
    ("status", "observation"),
    [
        (0xFDFD, "ready, status 0xfdfd"),
        (0x7D7D, "power not in order, status 0x7d7d"),
        (0x3D3D, "power and temperature not in order, status 0x3d3d"),
        (0, "no valid status"),
    ],
)
def test_a_digital_scan_head_is_described(library, status, observation):
    board = CBoard(library, BoardSettings(interface="xy2-100"))
    board.set_head(status)
    clock = ManualClock(5.0)
    findings = {each.check: each for each in check_bare_board(MemoryLink(board, clock), clock)}
    assert findings["scan head"].observation == observation
    assert (findings["scan head"].status == "ok") == observation.startswith("ready")


class PulsedLink(MemoryLink):
    """A link to a board whose trigger input sees an edge with each message."""

    def write(self, data):
        self._core.receive_trigger(self._now_us())
        super().write(data)


def test_edges_at_the_trigger_input_are_counted():
    assert examine()[0]["trigger"].observation == "no edge yet"
    count, _, rest = examine(PulsedLink)[0]["trigger"].observation.partition(" ")
    assert int(count) > 2
    assert rest == "edges since power-up, the last one during this examination"


def test_a_board_of_protocol_1_0_has_no_trigger(monkeypatch):
    monkeypatch.setattr(m, "MINOR", 0)
    findings, log = examine()
    assert list(findings) == [check for check in CHECKS if check != "trigger"]
    assert not [entry for entry in log if entry["event"] == "rx_error"]


def test_a_board_that_a_lease_arms_is_a_problem(monkeypatch):
    def arm(machine, duration_ms):
        machine.state = BoardState.ARMED

    monkeypatch.setattr(BoardMachine, "renew_lease", arm)
    finding = examine()[0]["lease, stop"]
    assert finding.status == "problem"
    assert "FAULT LINK after LEASE" in finding.observation, "it had no lease at its arming"


def test_a_silent_port_is_one_problem():
    findings, _ = examine(DeadLink)
    assert list(findings) == ["board"]
    assert findings["board"].observation == "no answer to HELLO within 3 s"


def test_the_command_examines_a_port(tmp_path, capsys):
    port = tmp_path / "tty"
    board = start_process([*SIMULATED, "--pty", port, "--log", tmp_path / "log"])
    try:
        while not port.exists():
            assert board.poll() is None
        assert run(["doctor", "--board", str(port), "--json"]) == 0
    finally:
        board.terminate()
        board.wait()
    found = {finding["check"]: finding["status"] for finding in json.loads(capsys.readouterr().out)["findings"]}
    assert {check: status for check, status in found.items() if check in CHECKS and check not in ("link", "clock")} == {
        check: "ok" for check in CHECKS if check not in ("link", "clock")
    }
    assert states([json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]) == {"DISARMED"}


def test_a_port_that_is_not_there_is_one_problem(tmp_path, capsys):
    assert run(["doctor", "--board", str(tmp_path / "tty")]) == 1
    assert "tty does not exist" in capsys.readouterr().out
