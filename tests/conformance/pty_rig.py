"""A real session on a serial port, a board process on another, and a proxy with fault injection between them."""

import os
import select
import threading
import time
import tty
from contextlib import suppress
from dataclasses import replace

import serial
from bench import Bench
from link_faults import LinkFaults, Witness
from scenario import audit_log
from session_rig import SessionRig, configured

from optodrive.core.clock import MonotonicClock
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.serial_port import SerialPort

TURN_S = 0.002
READ_MAX = 4096


class Proxy(threading.Thread):
    """Connects a pty for the host with the board's port, which is open as long as the host's is."""

    def __init__(self, board_port, link, up, down):
        super().__init__(daemon=True)
        self._board_port, self._link, self._up, self._down = board_port, link, up, down
        self._ending, self._cutting = threading.Event(), threading.Event()
        self._make_pty()
        self.start()

    def _make_pty(self):
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(slave))
        os.close(slave)

    def cut(self):
        """Remove and restore the host's port, as if unplugged."""
        self._cutting.set()

    @property
    def cutting(self):
        """Whether the port is not restored yet."""
        return self._cutting.is_set()

    def end(self):
        """Stop the thread and wait for it."""
        self._ending.set()
        self.join()
        os.close(self._master)

    def run(self):
        while not self._ending.is_set():
            if self._host_there():
                with serial.Serial(str(self._board_port), 1_000_000, timeout=0, exclusive=True) as board:
                    self._pass(board)
            else:
                self._ending.wait(TURN_S)
            if self._cutting.is_set():
                os.close(self._master)
                self._make_pty()
                self._cutting.clear()

    def _host_there(self):
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        return not any(flags & select.POLLHUP for _, flags in poller.poll(0))

    def _pass(self, board):
        while self._host_there() and not self._ending.is_set() and not self._cutting.is_set():
            select.select([self._master, board.fileno()], [], [], TURN_S)
            now_s = time.monotonic()
            with suppress(OSError):  # empty, or the host has just closed
                board.write(self._up.carry(self._from_host(), now_s))
                os.write(self._master, self._down.carry(board.read(READ_MAX), now_s))

    def _from_host(self):
        with suppress(BlockingIOError):
            return os.read(self._master, READ_MAX)
        return b""


class WitnessedPort(SerialPort):
    """A serial port that records all written bytes."""

    def __init__(self, port, witness):
        super().__init__(port, 1_000_000)
        self._witness = witness

    def write(self, data):
        self._witness.wrote(data)
        super().write(data)


class PtyRig(SessionRig):
    """A board of a kind behind a proxy. lease_s: by default more than this process is ever suspended."""

    def __init__(self, kind, folder, seed, loss=0.0, extra=0.0, pauses=0.0, lease_s=20.0):
        up, down = (LinkFaults(2 * seed + way, loss, extra, pauses) for way in (0, 1))
        self._bench = Bench(kind, folder)
        self.board = self._bench.board(lease_ms=round(1000 * lease_s))
        self.witness = Witness()
        link = folder / "host"
        self.proxy = Proxy(self.board.port, link, up, down)
        clock = MonotonicClock()
        port = WitnessedPort(str(link), self.witness)
        required = build_board_requirements(configured())
        limits = replace(required.limits, lease_ms=round(1000 * lease_s))
        session = BoardSession(port, clock, replace(required, lease_s=lease_s, limits=limits))
        super().__init__(session, clock, up, down)

    def finish(self):
        """Stop host, proxy and board. Check the log and return the number of pulses."""
        self.session.close()
        self.proxy.end()
        self._bench.finish(lambda board: None)
        events = self.board.events()
        audit_log(events)
        return self.witness.check(events)
