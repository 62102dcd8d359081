"""A real session and a board core in virtual time, with fault injection in both directions of the link."""

from link_faults import LinkFaults, Witness
from scenario import audit_log
from session_rig import SessionRig, configured

from optodrive.core.clock import ManualClock
from optodrive.core.errors import LinkError
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.session.arming import BITS_PER_BYTE
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.guards import BoardSettings
from optodrive.link.simulator.virtual_run import EXCHANGE_MIN_S, MemoryLink

FAULTS_EACH = 25_000


class Line:
    """One direction of a serial line with a byte rate, 0 for no limit."""

    def __init__(self, bytes_per_s):
        self._bytes_per_s = bytes_per_s
        self._waiting = b""
        self._passed_s = 0.0

    def carry(self, data, now_s):
        """Return the bytes that have passed."""
        if not self._bytes_per_s:
            return data
        if not self._waiting:
            self._passed_s = now_s
        self._waiting += data
        out = self._waiting[: int((now_s - self._passed_s) * self._bytes_per_s)]
        self._waiting = self._waiting[len(out) :]
        self._passed_s += len(out) / self._bytes_per_s
        return out


class FaultyMemoryLink(MemoryLink):
    """A memory link with fault injection.

    up: direction to the board
    """

    def __init__(self, core, clock, up, down, bytes_per_s=0):
        super().__init__(core, clock)
        self.up, self.down = up, down
        self.witness = Witness()
        self._bytes_per_s = bytes_per_s
        self.open()

    def open(self):
        """Open the link with an empty line."""
        self._up_line, self._down_line = Line(self._bytes_per_s), Line(self._bytes_per_s)
        self._broken = False

    def write(self, data):
        """Send bytes to the board."""
        if self._broken:
            raise LinkError("the link is broken")
        self.witness.wrote(data)
        self._to_board(data)

    def _to_board(self, data=b""):
        now_s = self._clock.now_s()
        arrived = self.up.carry(self._up_line.carry(data, now_s), now_s)
        if arrived:
            super().write(arrived)

    def read(self, timeout_s):
        """Return received bytes as soon as there are any. Advance the clock."""
        until_s, wait_s = self._clock.now_s() + timeout_s, EXCHANGE_MIN_S
        while not self._broken:
            sent = super().read(wait_s)
            self._to_board()
            now_s = self._clock.now_s()
            data = self.down.carry(self._down_line.carry(sent, now_s), now_s)
            if data or now_s >= until_s:
                return data
            wait_s = EXCHANGE_MIN_S if self._bytes_per_s else until_s - now_s
        raise LinkError("the link is broken")

    def break_down(self):
        """Remove the port. Both ends detect it."""
        self._broken = True
        self.close()


class VirtualRig(SessionRig):
    """A session and a board core in virtual time.

    loss, extra, pauses: of the faults in both directions; paced: limit the line to the configured baud rate
    make_core: (settings, sink, seed) → board core; settings: of the board
    """

    def __init__(
        self, seed, loss=0.0, extra=0.0, pauses=0.0, config=None, paced=False, make_core=BoardCore, **settings
    ):
        up, down = (LinkFaults(2 * seed + way, loss, extra, pauses) for way in (0, 1))
        clock = ManualClock(5.0)
        self.log = []
        self._state = "BOOT"
        config = config or configured()
        self.core = make_core(BoardSettings(**settings), self.log.append, seed=seed)
        self.link = FaultyMemoryLink(self.core, clock, up, down, config.board.baud / BITS_PER_BYTE if paced else 0)
        super().__init__(BoardSession(self.link, clock, build_board_requirements(config)), clock, up, down)

    def check(self):
        """Check and clear the log. Return the number of pulses."""
        assert not self.core.gate
        audit_log(self.log, self._state)
        self._state = self.core.state
        count = self.link.witness.check(self.log)
        self.log.clear()
        return count


def run_fault_sessions(rig, faults=FAULTS_EACH):
    """Run sessions until enough faults are injected. Return the number of sessions and pulses."""
    sessions = pulses = 0
    while rig.faults < faults:
        rig.live(3000, patience_s=4.0)
        pulses += rig.check()
        sessions += 1
    return sessions, pulses
