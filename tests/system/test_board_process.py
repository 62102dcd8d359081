"""The simulated board as a process on a pseudo-terminal, in real time: its log and its exits."""

import itertools
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise

import pytest
import serial

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, FrameDecoder, encode_frame
from rig import wait_for

FIELDS = {
    "gate": {"on", "reason"},
    "state": {"state", "before", "reason"},
    "fault": {"fault"},
    "pulse": {"index", "x", "y", "duty", "on_us", "off_us"},
    "rx_error": {"bad_frames"},
    "input": {"input", "value"},
    "port": {"open"},
    "lease": {"until_us"},
}
CENTRE = 32768


class Host:
    """Minimal host on a serial port that renews the lease while it waits."""

    def __init__(self, port):
        self.port = serial.Serial(str(port), 1_000_000, timeout=0.005, exclusive=True)
        self.decoder = FrameDecoder()
        self.session, self.seq, self.heard = 0, 0, []

    def say(self, *messages):
        for message in messages:
            seq = self.seq if message.SEQUENCED else 0
            self.seq = (self.seq + message.SEQUENCED) % 256
            self.port.write(encode_frame(Frame(message.TYPE, seq, self.session, message.encode_body())))

    def hear(self):
        for frame in self.decoder.feed(self.port.read(4096)):
            if self.session and frame.session != self.session:
                continue  # of a session before, from the buffer of the port
            self.heard.append(m.parse_message(frame.type, frame.body))

    def wait(self, condition, what, lease=True):
        """Read messages until condition() is true. The timeout of pytest shows the text that names it."""
        while not condition():
            if lease and self.session:
                self.say(m.Lease(60_000))
            self.hear()

    def of(self, kind):
        return [message for message in self.heard if isinstance(message, kind)]

    def states(self):
        return [m.STATES[event.state] for event in self.of(m.Event)]

    def hello(self):
        """Perform the handshake. HELLO is repeated, because the board notices the opened port with a delay."""
        for nonce in itertools.count():
            self.session = self.seq = 0
            self.say(m.Hello(1, 0, nonce))
            for _ in range(50):
                self.hear()
                if self.of(m.HelloReply) and self.of(m.HelloReply)[-1].host_nonce == nonce:
                    self.session = self.of(m.HelloReply)[-1].session
                    self.heard = [message for message in self.heard if not isinstance(message, m.Executed)]
                    return self
        return None

    def arm(self):
        self.say(m.ArmReq(3))
        self.wait(lambda: self.of(m.ArmChallenge), "the challenge")
        challenge = self.of(m.ArmChallenge)[-1]
        self.say(m.ArmConfirm(challenge.host_nonce, challenge.board_nonce))
        self.wait(lambda: "ARMED" in self.states(), "ARMED")
        return self

    def play(self, points, first=0):
        frames = [points[at : at + m.POINTS_MAX] for at in range(0, len(points), m.POINTS_MAX)]
        for k, chunk in enumerate(frames):
            index = first + k * m.POINTS_MAX
            self.say(m.Data(index, b"".join(m.POINT.pack(*point) for point in chunk)))
        self.say(m.Start(1, first, 0, 1), m.End(1, first + len(points)))

    def close(self):
        self.port.close()


@pytest.fixture
def open_host():
    hosts = []

    def open_port(board):
        hosts.append(Host(board.port))
        return hosts[-1]

    yield open_port
    for host in hosts:
        host.close()


def points(count, on_us=2000):
    """Return points in a row of cells, every fifth with the gate off."""
    return [
        (CENTRE + 2000 * (k % 5 - 2), CENTRE, 3000, 0 if k % 5 == 4 else on_us, 0 if k % 5 == 4 else 20_000 + k)
        for k in range(count)
    ]


def test_the_log_of_fifty_points(board, open_host):
    host = open_host(board).hello().arm()
    planned = points(50)
    host.play(planned)
    host.wait(lambda: sum(len(x.records) for x in host.of(m.Executed)) == 50, "50 executed points")
    host.close()
    wait_for(lambda: board.of("port")[-1]["open"] is False, "the board to notice the closed port")

    events = board.events()
    assert all(set(entry) == {"t_us", "event"} | FIELDS[entry["event"]] for entry in events)
    times = [entry["t_us"] for entry in events]
    assert all(isinstance(t_us, int) for t_us in times)
    emitting = [k for k, point in enumerate(planned) if point[3]]
    pulses = board.of("pulse")
    assert [entry["index"] for entry in pulses] == emitting
    assert [(entry["x"], entry["y"], entry["duty"]) for entry in pulses] == [
        (planned[k][0], planned[k][1], planned[k][4]) for k in emitting
    ]
    assert all(entry["off_us"] - entry["on_us"] == 2000 for entry in pulses)
    edges = [(entry["t_us"], entry["on"]) for entry in board.of("gate")]
    assert edges == [edge for entry in pulses for edge in ((entry["on_us"], True), (entry["off_us"], False))]
    assert [entry["reason"] for entry in board.of("gate")][:2] == ["point 0", "point 0 done"]
    transitions = [(entry["before"], entry["state"], entry["reason"]) for entry in board.of("state")]
    assert transitions == [
        ("BOOT", "DISARMED", "boot"),
        ("DISARMED", "ARMING", "arm requested"),
        ("ARMING", "ARMED", "armed"),
        ("ARMED", "RUNNING", "start"),
        ("RUNNING", "ARMED", "job done"),
        ("ARMED", "DISARMED", "link lost"),
    ]
    reported = [record for message in host.of(m.Executed) for record in message.records]
    assert [(tick, on, duty) for tick, on, duty in reported if on] == [
        (entry["on_us"], 2000, entry["duty"]) for entry in pulses
    ]


def test_bytes_of_a_closed_host_do_not_reach_the_next(board, open_host):
    host = open_host(board).hello()
    host.say(*[m.Get()] * 400, m.ArmReq(1))
    host.close()
    wait_for(lambda: board.of("port")[-1]["open"] is False, "the board to notice the closed port")
    again = open_host(board).hello()
    again.say(m.Get())
    again.wait(lambda: again.of(m.Status), "a status", lease=False)
    (status,) = again.of(m.Status)
    assert m.STATES[status.state] == "DISARMED"
    assert status.fault == 0


def test_a_descheduled_process_keeps_board_time(board, open_host):
    """Messages count at the time of their arrival, and due points run at their scheduled times."""
    host = open_host(board).hello().arm()
    host.play(points(200, on_us=2000))
    host.wait(lambda: len(board.of("pulse")) > 5, "pulses")
    os.kill(board.process.pid, signal.SIGSTOP)
    for _ in range(15):
        host.say(m.Lease(60_000))
        time.sleep(0.02)
    os.kill(board.process.pid, signal.SIGCONT)
    host.wait(lambda: sum(len(x.records) for x in host.of(m.Executed)) == 200, "every point")
    assert board.of("fault") == []
    gaps_us = {after["on_us"] - before["off_us"] for before, after in pairwise(board.of("pulse"))}
    assert gaps_us == {3000, 6000}


# --- scripts, limits, exits -----------------------------------------------------------------------------------------


@pytest.fixture
def while_playing():
    """Time of a step of a script during the first job, and a function that returns this time on the log's clock, µs."""
    # One microsecond less, because the log rounds both times.
    return 'from = "light"\nat_s = 0.5', lambda board: board.of("gate")[0]["t_us"] + 499_999


def test_limits_come_from_the_file(make_board, open_host):
    board = make_board(limits="max_on_us = 12345\nlease_ms = 60\n")
    host = open_host(board).hello()
    limits = host.of(m.HelloReply)[-1].limits
    assert (limits.max_on_us, limits.lease_ms) == (12345, 60)


def start(*arguments, **options):
    command = [sys.executable, "-m", "optodrive.link.simulator.board_process", *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)


@pytest.mark.parametrize(
    ("option", "text", "says"),
    [
        ("--limits", "max_on = 1", "max_on_us"),
        ("--script", None, "a readable file"),
        ("--log", None, "--log"),
        ("--pty", "a file that is no link", "free"),
        ("--bits", 8, "unrecognized arguments: --bits 8"),
    ],
)
def test_bad_options_are_one_line_and_status_2(tmp_path, option, text, says):
    path = tmp_path / ("there.toml" if text else "no/such/file")
    is_a_file = option != "--bits"
    if text and is_a_file:
        path.write_text(text)
    value = path if is_a_file else text
    arguments = ["--pty", tmp_path / "tty"] if option != "--pty" else []
    board = start(*arguments, option, value)
    _, error = board.communicate()
    assert board.returncode == 2
    assert error.startswith("optodrive.link.simulator.board_process: ")
    assert error.count("\n") == 1
    assert says in error
    assert not (tmp_path / "tty").exists()
    if option == "--pty" and text:
        assert path.read_text() == text


@pytest.fixture
def start_board(tmp_path):
    """Return a function that starts a board with options, and returns its process and its port."""
    boards = []

    def start_with(*options):
        port = tmp_path / f"tty{len(boards)}"
        boards.append(start("--pty", port, *options))
        wait_for(port.exists, "the port")
        return boards[-1], port

    yield start_with
    for board in boards:
        board.kill()
        board.communicate()


def test_exit_when_closed_removes_the_port(start_board):
    board, port = start_board("--exit-when-closed", "0.01")
    time.sleep(0.2)  # it waits for its first host
    host = Host(port).hello()
    time.sleep(0.2)
    host.say(m.Get())
    host.wait(lambda: host.of(m.Status), "a status")
    host.close()
    assert board.wait() == 0
    assert not port.is_symlink()


def test_exit_when_closed_leaves_time_for_another_host(start_board, tmp_path):
    log = tmp_path / "log"
    _, port = start_board("--exit-when-closed", "1000", "--log", log)
    Host(port).hello().close()
    wait_for(lambda: '"open": false' in log.read_text(), "the board to notice the closed port")
    Host(port).hello().close()


def test_sigterm_turns_the_gate_off_first(make_board, open_host):
    board = make_board()
    host = open_host(board).hello().arm()
    host.play(points(200, on_us=20_000))
    host.wait(lambda: board.of("gate") and board.of("gate")[-1]["on"], "light")
    board.stop()
    assert board.process.returncode == 0
    assert board.of("gate")[-1]["on"] is False
    assert board.of("state")[-1]["reason"] == "link lost"


def test_bytes_arrive_at_the_line_rate(start_board):
    """By the board's clock, from a request before them to the last of them."""
    _, port = start_board("--baud", 115_200)
    host = Host(port).hello()
    frame = encode_frame(Frame(m.ClockRequest.TYPE, 0, host.session, m.ClockRequest(0x01010101).encode_body()))
    count = 1 - (-2000 // len(frame))
    host.port.write(frame)
    host.wait(lambda: host.of(m.ClockReply), "the first answer", lease=False)
    host.port.write(frame * (count - 1))
    host.wait(lambda: len(host.of(m.ClockReply)) == count, "all answers", lease=False)
    ticks = [reply.tick for reply in host.of(m.ClockReply)]
    assert ticks[-1] - ticks[0] >= 150_000, "2,000 bytes are 174 ms of 115,200 baud"
    host.close()
