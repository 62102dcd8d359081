"""Test bench of the scenarios: a board process with its log, and a minimal host on its port."""

import json
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

import serial
from wire_format import DATA_POINTS_MAX, HOST, SEQUENCED, MessageReader, body_of, frame

from firmware_ports import build_board
from rig import SIMULATED

PATIENCE_S = 15.0
START_S = 60.0
CENTRE = 32768
WINDOW = 8
WITH_THE_END = 65_535
"""A watermark that no queue reaches, so that the job begins at its END independently of the speed of line and board."""
LEASE_EVERY_S = 0.02
BRIGHT = dict(max_on_us=65_000, spot_uj=4_000_000_000, spot_leak_uw=4_000_000_000, rest_us=0, lease_ms=5000)
"""Limits that permit long pulses and tolerate a host that is scheduled late."""
PATIENT = dict(lease_ms=5000)


class TooLateError(Exception):
    """The host was scheduled too late for a conclusion about the board."""


class BoardKind(NamedTuple):
    """A board implementation under test.

    command: of its process; port: firmware port to build instead; spared: reasons for exempting it from subjects, by
    name; at_once: number of concurrent instances; late_us: permitted lateness of its logged edges
    """

    name: str
    command: tuple[str, ...] = ()
    port: str = ""
    spared: dict[str, str] = {}  # noqa: RUF012 - nobody writes to it
    at_once: int = 12
    late_us: int = 0

    def ready(self, folder, mutant=0):
        """Return this kind with its port built in a folder. mutant: number of the disabled guard."""
        return self._replace(command=build_board(folder, mutant, self.port)) if self.port else self

    def spares(self, subject):
        """Return the reason for exempting it from a subject, '' if it is tested."""
        return self.spared.get(subject, "")


ABOUT_ITSELF = "the simulated board does B1 to B13: it has no tick, readback or watchdog of its own"
LINK_FAULTS = "link faults"
TOO_FAST = "its witness leaves the emulator byte by byte, some 2 ms a pulse: too slow for a point every 1.2 ms"
BOARD_KINDS = [
    BoardKind("python", SIMULATED, at_once=8, spared=dict.fromkeys(("B14", "B15"), ABOUT_ITSELF)),
    BoardKind("host", port="host"),
    BoardKind("qemu", port="mps2-an385", spared={LINK_FAULTS: TOO_FAST}, at_once=6),
]
"""All board implementations."""


class BoardProcess:
    """A running board process. limits: keys of its limits file; script: text of its script file."""

    def __init__(self, kind, folder, limits, script):
        self.port, self.late_us = folder / "tty", kind.late_us
        self._script = script
        self._log = folder / "log"
        self._events, self._read = [], 0
        arguments = ["--pty", self.port, "--log", self._log]
        for option, text in (("--limits", toml(limits)), ("--script", script)):
            if text:
                path = folder / option.strip("-")
                path.write_text(text)
                arguments += [option, path]
        self.process = subprocess.Popen([*kind.command, *arguments])
        try:
            wait_for(lambda: self.port.exists() or self.process.poll() is not None, "the board's port", START_S)
            assert self.process.poll() is None, f"the board ended by itself: {self.process.returncode}"
        except BaseException:
            self.process.kill()
            self.process.wait()
            raise

    def events(self):
        """Return all log entries so far."""
        if self._log.exists():
            with self._log.open("rb") as log:
                log.seek(self._read)
                whole = log.read().rpartition(b"\n")[0]
            if whole:
                self._read += len(whole) + 1
                self._events += map(json.loads, whole.splitlines())
        return list(self._events)

    def of(self, kind):
        """Return the log entries of a kind."""
        return [entry for entry in self.events() if entry["event"] == kind]

    def states(self):
        """Return (state, reason) of each state change."""
        return [(entry["state"], entry["reason"]) for entry in self.of("state")]

    def pulse_numbers(self):
        """Return the numbers of all pulses."""
        return [entry["index"] for entry in self.of("pulse")]

    def is_gate_on(self):
        """Return whether the gate is on."""
        edges = self.of("gate")
        return bool(edges) and edges[-1]["on"]

    def kept(self):
        """Return whether the log shows an overloaded machine: an unscripted late tick, or a HOLD of a whole second."""
        ticked_late = "TICK" in [entry["fault"] for entry in self.of("fault")] and "late_tick" not in self._script
        return ticked_late or ("DISARMED", "hold too long") in self.states()

    def end(self):
        """Stop the process."""
        self.process.terminate()
        self.process.wait(timeout=10)


def toml(limits):
    """Format keys with numbers, booleans or strings as TOML."""
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in limits.items())


def wait_for(condition, what, patience_s=PATIENCE_S):
    """Poll until condition() is true; fail after patience_s."""
    until = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < until, f"timed out waiting for {what}"
        time.sleep(0.005)


class Host:
    """A host on a real serial port that renews the lease while it waits, unless disabled."""

    def __init__(self, board, record=None):
        self.board = board
        self.port = serial.Serial(str(board.port), 1_000_000, timeout=0.005, exclusive=True)
        self.written = [] if record is None else record
        self.session = self.seq = self.index = 0
        self.received = []
        self._reader = MessageReader()
        self._leased_s = 0.0

    # --- messages ---

    def raw(self, data):
        """Write bytes."""
        self.written.append((time.monotonic(), data))
        self.port.write(data)

    def frame(self, name, seq=None, session=None, **fields):
        """Encode a message; a sequenced one gets the next sequence number."""
        if seq is None:
            seq = self.seq if name in SEQUENCED else 0
            self.seq = (self.seq + (name in SEQUENCED)) % 256
        session = self.session if session is None else session
        return frame(HOST[name][0], seq, session, body_of(name, **fields))

    def send(self, name, **fields):
        """Send a message without waiting."""
        self.raw(self.frame(name, **fields))

    def receive(self):
        """Read the messages that have arrived."""
        self.received += self._reader.take(self.port.read(max(1, self.port.in_waiting)))

    def of(self, name):
        """Return the received messages of a kind."""
        return [message for message in self.received if message.name == name]

    def wait(self, condition, what, lease=True, patience_s=PATIENCE_S):
        """Read messages until condition() is true."""
        until = time.monotonic() + patience_s
        while not condition():
            assert time.monotonic() < until, f"timed out waiting for {what}; log {self.board.events()[-8:]}"
            if lease:
                self.lease()
            self.receive()

    def lease(self):
        """Renew the lease, at a limited rate."""
        if self.session and time.monotonic() - self._leased_s > LEASE_EVERY_S:
            self._leased_s = time.monotonic()
            self.send("LEASE", ms=60_000)

    def pause(self, duration_s, lease=True):
        """Wait for a time."""
        until = time.monotonic() + duration_s
        self.wait(lambda: time.monotonic() >= until, "the time", lease)

    def request(self, data=b""):
        """Send bytes; return the board's answers and its status after them."""
        before = len(self.received)
        self.raw(data)
        for _ in range(2):  # an ACK may follow its batch, so the answers are complete only at the second status
            count = len(self.of("STATUS"))
            self.send("GET")
            self.wait(lambda count=count: len(self.of("STATUS")) > count, "a status", lease=False)
        status = self.of("STATUS")[-1]
        return [m for m in self.received[before:] if m.name != "STATUS"], status

    def order(self, *frames):
        """Send frames in batches of the window size; return the reasons of all NAKs."""
        answers = []
        for at in range(0, len(frames), WINDOW):
            self.lease()  # hundreds of frames may take longer than one lease
            answers.append(self.request(b"".join(frames[at : at + WINDOW]))[0])
        return [message.reason for messages in answers for message in messages if message.name == "NAK"]

    def send_checked(self, name, **fields):
        """Send one message; return the reasons of its NAKs."""
        return self.order(self.frame(name, **fields))

    def status(self):
        """Request the board's status."""
        return self.request()[1]

    # --- session, arming, jobs ---

    def hello(self, major=1):
        """Begin a session and return the board's reply; repeat HELLO, as a board may detect the open port late."""
        nonce = 0
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            self.session = self.seq = self.index = 0
            nonce += 1
            before = len(self.received)
            self.send("HELLO", major=major, minor=0, host_nonce=nonce)
            soon = time.monotonic() + 0.5
            while time.monotonic() < soon:
                self.receive()
                for message in self.received[before:]:
                    if message.name == "HELLO_REPLY" and message.host_nonce == nonce:
                        self.session = message.session
                        return message
        raise AssertionError("no answer to HELLO")

    def challenge(self, host_nonce=99):
        """Send ARM_REQ and return the challenge."""
        answers, _ = self.request(self.frame("ARM_REQ", host_nonce=host_nonce))
        (challenge,) = [message for message in answers if message.name == "ARM_CHALLENGE"]
        return challenge

    def arm(self):
        """Arm the board by the regular sequence."""
        count = self.board.states().count(("ARMED", "armed"))
        challenge = self.challenge()
        self.send("ARM_CONFIRM", host_nonce=challenge.host_nonce, board_nonce=challenge.board_nonce)
        self.wait(lambda: self.board.states().count(("ARMED", "armed")) > count, "ARMED")
        return self

    def data(self, *points):
        """Build a DATA frame of points (x, y, dark_us, on_us, duty), numbered after the last one."""
        first, self.index = self.index, self.index + len(points)
        return self.frame("DATA", first_index=first, points=points)

    def play(self, *points, end=True, start_tick=0, watermark=1):
        """Send points, START and END at once; return the reasons of the NAKs."""
        first = self.index
        pieces = [points[at : at + DATA_POINTS_MAX] for at in range(0, len(points), DATA_POINTS_MAX)]
        frames = [self.data(*piece) for piece in pieces]
        frames.append(self.frame("START", job=1, first_index=first, start_tick=start_tick, watermark=watermark))
        if end:
            frames.append(self.frame("END", job=1, end_index=self.index))
        return self.order(*frames)

    def close(self):
        """Close the port."""
        self.port.close()


class Bench:
    """Creates and stops the boards and hosts of one scenario."""

    def __init__(self, kind, folder):
        self.kind = kind
        self._folder = Path(folder)
        self._boards, self._hosts = [], []

    def board(self, script="", **limits):
        """Start a board."""
        folder = self._folder / f"board{len(self._boards)}"
        folder.mkdir()
        self._boards.append(BoardProcess(self.kind, folder, limits, script))
        return self._boards[-1]

    def host(self, board):
        """Open a host on the board's port."""
        self._hosts.append(Host(board))
        return self._hosts[-1]

    def greeted(self, script="", **limits):
        """Return a host in session with a new board."""
        host = self.host(self.board(script, **limits))
        host.hello()
        return host

    def ready(self, script="", **limits):
        """Return a host that has armed a new board."""
        return self.greeted(script, **limits).arm()

    def kept(self):
        """Return whether a board was suspended by the operating system for too long for a conclusion."""
        return any(board.kept() for board in self._boards)

    def finish(self, audit):
        """Close all hosts and boards; pass each board to audit."""
        try:
            for host in self._hosts:
                host.close()
        finally:
            for board in self._boards:
                board.end()
        for board in self._boards:
            audit(board)


def here(on_us, dark_us=0, duty=65535, x=CENTRE, y=CENTRE):
    """Return a point, by default at the centre."""
    return x, y, dark_us, on_us, duty
