"""The real session and the board's core in virtual time, with fire on both directions of the link between them."""

from fire import Fire, Witness
from fire_host import FireHost, configured
from scenario import audit_log

from optodrive.core.clock import ManualClock
from optodrive.core.errors import LinkError
from optodrive.link.session.board_requirements import BITS_PER_BYTE, BoardRequirements
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.board_limits import BoardSettings
from optodrive.link.simulator.memory_link import EXCHANGE_MIN_S, MemoryLink


class Line:
    """One direction of a serial line: bytes come out at its pace, or at once for a rate of 0."""

    def __init__(self, bytes_per_s):
        self._bytes_per_s = bytes_per_s
        self._waiting = b""
        self._passed_s = 0.0

    def carry(self, data, now_s):
        """What comes out now."""
        if not self._bytes_per_s:
            return data
        if not self._waiting:
            self._passed_s = now_s
        self._waiting += data
        out = self._waiting[: int((now_s - self._passed_s) * self._bytes_per_s)]
        self._waiting = self._waiting[len(out) :]
        self._passed_s += len(out) / self._bytes_per_s
        return out


class FireLink(MemoryLink):
    """The link in memory under fire; up: to the board."""

    def __init__(self, core, clock, up, down, bytes_per_s=0):
        super().__init__(core, clock)
        self.up, self.down = up, down
        self.witness = Witness()
        self._bytes_per_s = bytes_per_s
        self.open()

    def open(self):
        """Nothing of what was on the line before is there."""
        self._up_line, self._down_line = Line(self._bytes_per_s), Line(self._bytes_per_s)
        self._broken = False

    def write(self, data):
        """Towards the board."""
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
        """What has come through, as soon as something has; time passes."""
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
        """The port is gone: both ends notice."""
        self._broken = True
        self.close()


class FireRig(FireHost):
    """loss, extra, pauses: of the fire in both directions; paced: at the configuration's baud; settings: the board's.

    make_core: (settings, sink, seed) → the board, of which the simulated one is not the only one.
    """

    def __init__(
        self, seed, loss=0.0, extra=0.0, pauses=0.0, config=None, paced=False, make_core=BoardCore, **settings
    ):
        up, down = (Fire(2 * seed + way, loss, extra, pauses) for way in (0, 1))
        clock = ManualClock(5.0)
        self.log = []
        self._state = "BOOT"
        config = config or configured()
        self.core = make_core(BoardSettings(**settings), self.log.append, seed=seed)
        self.link = FireLink(self.core, clock, up, down, config.board.baud / BITS_PER_BYTE if paced else 0)
        super().__init__(BoardSession(self.link, clock, BoardRequirements.from_config(config)), clock, up, down)

    def check(self):
        """The log so far keeps its word; forget it. The number of pulses."""
        assert not self.core.gate
        audit_log(self.log, self._state)
        self._state = self.core.state
        count = self.link.witness.check(self.log)
        self.log.clear()
        return count
