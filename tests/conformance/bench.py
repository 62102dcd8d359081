"""A board as a process, its log as witness, and a host of a few lines on its port: what the scenarios work with."""

import json
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

import serial
from spoken import DATA_POINTS_MAX, HOST, SEQUENCED, Ear, body_of, frame

from firmware_ports import build_board
from rig import SIMULATED

PATIENCE_S = 15.0
START_S = 60.0
CENTRE = 32768
WINDOW = 8
WITH_THE_END = 65_535
"""A watermark that no queue reaches: the job begins when its END has come, however slow line and board are."""
LEASE_EVERY_S = 0.02
BRIGHT = dict(max_on_us=65_000, spot_uj=4_000_000_000, spot_leak_uw=4_000_000_000, rest_us=0, lease_ms=5000)
"""Limits of a board that stays lit as long as a scenario needs it, and forgives a host that is scheduled late."""
PATIENT = dict(lease_ms=5000)


class TooLateError(Exception):
    """This host was scheduled too late for what it wanted to see: it says nothing about the board."""


class BoardKind(NamedTuple):
    """A board to be judged.

    command: how it starts; port: the firmware's port that is built for it instead; spared: why it is not asked for
    a guard, or another subject, by name; at_once: how many of it run side by side; late_us: how late its logged edges
    may be.
    """

    name: str
    command: tuple[str, ...] = ()
    port: str = ""
    spared: dict[str, str] = {}  # noqa: RUF012 - nobody writes to it
    at_once: int = 12
    late_us: int = 0

    def ready(self, folder, mutant=0):
        """The same kind with its port built in a folder. mutant: the guard it lacks."""
        return self._replace(command=build_board(folder, mutant, self.port)) if self.port else self

    def spares(self, subject):
        """Why it is not asked for a subject, '' where it is."""
        return self.spared.get(subject, "")


ABOUT_ITSELF = "the simulated board does B1 to B13: it has no tick, readback or watchdog of its own"
UNDER_FIRE = "link under fire"
TOO_FAST = "its witness leaves the emulator byte by byte, some 2 ms a pulse: too slow for a point every 1.2 ms"
BOARD_KINDS = [
    BoardKind("python", SIMULATED, at_once=8, spared=dict.fromkeys(("B14", "B15"), ABOUT_ITSELF)),
    BoardKind("host", port="host"),
    BoardKind("qemu", port="mps2-an385", spared={UNDER_FIRE: TOO_FAST}, at_once=6),
]
"""One line for each implementation."""


class BoardProcess:
    """A board that runs; limits: its file's keys; script: its file's text."""

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
        """The log so far."""
        if self._log.exists():
            with self._log.open("rb") as log:
                log.seek(self._read)
                whole = log.read().rpartition(b"\n")[0]
            if whole:
                self._read += len(whole) + 1
                self._events += map(json.loads, whole.splitlines())
        return list(self._events)

    def of(self, kind):
        """The log's entries of a kind."""
        return [entry for entry in self.events() if entry["event"] == kind]

    def states(self):
        """(state, reason) of every change."""
        return [(entry["state"], entry["reason"]) for entry in self.of("state")]

    def executed(self):
        """Numbers of the pulses."""
        return [entry["index"] for entry in self.of("pulse")]

    def pulsed(self):
        """Whether the gate is on."""
        edges = self.of("gate")
        return bool(edges) and edges[-1]["on"]

    def kept(self):
        """Whether its log says that this machine was too busy: a late tick nobody ordered, a HOLD of a whole second."""
        ticked_late = "TICK" in [entry["fault"] for entry in self.of("fault")] and "late_tick" not in self._script
        return ticked_late or ("DISARMED", "hold too long") in self.states()

    def end(self):
        """Stop it."""
        self.process.terminate()
        self.process.wait(timeout=10)


def toml(limits):
    """Keys and numbers, flags or words as TOML."""
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in limits.items())


def wait_for(condition, what, patience_s=PATIENCE_S):
    """Poll until condition() is true."""
    until = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < until, f"waited in vain for {what}"
        time.sleep(0.005)


class Host:
    """A host on a real serial port; it renews the lease whenever it waits, unless told not to."""

    def __init__(self, board, record=None):
        self.board = board
        self.port = serial.Serial(str(board.port), 1_000_000, timeout=0.005, exclusive=True)
        self.written = [] if record is None else record
        self.session = self.seq = self.index = 0
        self.heard = []
        self._ear = Ear()
        self._leased_s = 0.0

    # --- saying and hearing ---

    def raw(self, data):
        """Write bytes."""
        self.written.append((time.monotonic(), data))
        self.port.write(data)

    def frame(self, name, seq=None, session=None, **fields):
        """A message as bytes; the next sequence number is its own where it takes one."""
        if seq is None:
            seq = self.seq if name in SEQUENCED else 0
            self.seq = (self.seq + (name in SEQUENCED)) % 256
        session = self.session if session is None else session
        return frame(HOST[name][0], seq, session, body_of(name, **fields))

    def say(self, name, **fields):
        """Say a message, wait for nothing."""
        self.raw(self.frame(name, **fields))

    def hear(self):
        """Take in what has arrived."""
        self.heard += self._ear.take(self.port.read(max(1, self.port.in_waiting)))

    def of(self, name):
        """What was heard of a kind."""
        return [message for message in self.heard if message.name == name]

    def wait(self, condition, what, lease=True, patience_s=PATIENCE_S):
        """Hear until condition() is true."""
        until = time.monotonic() + patience_s
        while not condition():
            assert time.monotonic() < until, f"waited in vain for {what}; log {self.board.events()[-8:]}"
            if lease:
                self.lease()
            self.hear()

    def lease(self):
        """Renew it, not too often."""
        if self.session and time.monotonic() - self._leased_s > LEASE_EVERY_S:
            self._leased_s = time.monotonic()
            self.say("LEASE", ms=60_000)

    def pause(self, duration_s, lease=True):
        """Let time pass."""
        until = time.monotonic() + duration_s
        self.wait(lambda: time.monotonic() >= until, "the time", lease)

    def ask(self, data=b""):
        """Send bytes; what the board said to them, and its status after that."""
        before = len(self.heard)
        self.raw(data)
        for _ in range(2):  # an ACK may follow the batch it answers: only what comes before the second status is all
            count = len(self.of("STATUS"))
            self.say("GET")
            self.wait(lambda count=count: len(self.of("STATUS")) > count, "a status", lease=False)
        status = self.of("STATUS")[-1]
        return [m for m in self.heard[before:] if m.name != "STATUS"], status

    def order(self, *frames):
        """Send frames, as many together as may be unanswered; the reasons of the NAKs they met."""
        said = []
        for at in range(0, len(frames), WINDOW):
            self.lease()  # hundreds of frames may take longer than one lasts
            said.append(self.ask(b"".join(frames[at : at + WINDOW]))[0])
        return [message.reason for messages in said for message in messages if message.name == "NAK"]

    def tell(self, name, **fields):
        """Send one message; the reasons of the NAKs it met."""
        return self.order(self.frame(name, **fields))

    def status(self):
        """The board's status now."""
        return self.ask()[1]

    # --- the way to light ---

    def hello(self, major=1):
        """A new session, and the board's reply; repeated, as a board may notice late that its port is open."""
        nonce = 0
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            self.session = self.seq = self.index = 0
            nonce += 1
            before = len(self.heard)
            self.say("HELLO", major=major, minor=0, host_nonce=nonce)
            soon = time.monotonic() + 0.5
            while time.monotonic() < soon:
                self.hear()
                for message in self.heard[before:]:
                    if message.name == "HELLO_REPLY" and message.host_nonce == nonce:
                        self.session = message.session
                        return message
        raise AssertionError("no answer to HELLO")

    def challenge(self, host_nonce=99):
        """ARM_REQ, and the challenge."""
        said, _ = self.ask(self.frame("ARM_REQ", host_nonce=host_nonce))
        (challenge,) = [message for message in said if message.name == "ARM_CHALLENGE"]
        return challenge

    def arm(self):
        """Arm by the book."""
        count = self.board.states().count(("ARMED", "armed"))
        challenge = self.challenge()
        self.say("ARM_CONFIRM", host_nonce=challenge.host_nonce, board_nonce=challenge.board_nonce)
        self.wait(lambda: self.board.states().count(("ARMED", "armed")) > count, "ARMED")
        return self

    def data(self, *points):
        """DATA for (x, y, dark_us, on_us, duty), counting on from the last."""
        first, self.index = self.index, self.index + len(points)
        return self.frame("DATA", first_index=first, points=points)

    def play(self, *points, end=True, start_tick=0, watermark=1):
        """Points, START and END at once; the NAKs."""
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
    """Makes boards and hosts for one scenario, and ends them."""

    def __init__(self, kind, folder):
        self.kind = kind
        self._folder = Path(folder)
        self._boards, self._hosts = [], []

    def board(self, script="", **limits):
        """A board that has just been powered up."""
        folder = self._folder / f"board{len(self._boards)}"
        folder.mkdir()
        self._boards.append(BoardProcess(self.kind, folder, limits, script))
        return self._boards[-1]

    def host(self, board):
        """A host with the board's port open."""
        self._hosts.append(Host(board))
        return self._hosts[-1]

    def greeted(self, script="", **limits):
        """A host in session with a new board."""
        host = self.host(self.board(script, **limits))
        host.hello()
        return host

    def ready(self, script="", **limits):
        """A host that has armed a new board."""
        return self.greeted(script, **limits).arm()

    def kept(self):
        """Whether a board of it was kept from the processor, or from its host, too long to be judged."""
        return any(board.kept() for board in self._boards)

    def finish(self, audit):
        """Close everything; audit gets each board's whole log."""
        try:
            for host in self._hosts:
                host.close()
        finally:
            for board in self._boards:
                board.end()
        for board in self._boards:
            audit(board)


def here(on_us, dark_us=0, duty=65535, x=CENTRE, y=CENTRE):
    """A point at the centre, or near it."""
    return x, y, dark_us, on_us, duty
