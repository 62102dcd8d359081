"""A real session over any link, driven as by its application: connect, arm manually, stream points."""

import numpy as np

from displays import DISPLAYS
from optodrive.core.errors import LinkError
from optodrive.device.config import Config
from optodrive.link.protocol.quantisation import WirePoints

STEP_S = 0.002
PLACES = ((30_500, 32_000), (34_000, 32_000), (30_500, 33_500), (34_000, 33_500))


def configured(lease_s=0.1, baud=1_000_000):
    """Return the configuration of the smallest display with a lease and a baud rate."""
    table = DISPLAYS["display-16"].config.model_dump()
    table["board"] |= {"lease_s": lease_s, "baud": baud}
    return Config.model_validate(table)


class Points:
    """Generates distinct points."""

    def __init__(self):
        self._serial = 0

    def make(self, count, dark_us=200):
        """Return [count] points of about half a millisecond, with pulses at four positions in turn, eight at each."""
        serial = self._serial + np.arange(count)
        self._serial += count
        places = np.array(PLACES)[serial // 8 % 4]
        places[:, 1] += serial // 60_000
        columns = (places, np.full(count, dark_us), np.full(count, 350), 1 + serial % 60_000)
        return WirePoints(np.column_stack(columns).astype(np.uint16), np.arange(count))


class SessionRig:
    """A session with a clock, points, and fault injection in both directions."""

    def __init__(self, session, clock, up, down):
        self.session, self.clock, self.up, self.down = session, clock, up, down
        self.points = Points()

    @property
    def faults(self):
        """Return the number of injected faults."""
        return sum(self.up.counts.values()) + sum(self.down.counts.values())

    def until(self, condition, patience_s):
        """Step until condition() is true or patience_s has passed. Return whether it is true."""
        give_up_s = self.clock.now_s() + patience_s
        while not condition():
            if self.clock.now_s() > give_up_s:
                return False
            self.session.step(STEP_S, renew_lease=True)
        return True

    def armed(self, patience_s=4.0):
        """Arm once, as a user does. Return whether the board is armed."""
        if self.session.board.state == "FAULT":
            self.session.disarm()
            self.until(lambda: self.session.board.state == "DISARMED", 1.0)
        if self.session.board.state != "DISARMED":
            return False
        self.session.arm()
        return self.until(lambda: self.session.is_ready, patience_s)

    def begin(self, count, dark_us=200, ahead_s=0.25):
        """Stream points from a short lead time on."""
        return self.session.begin(self.points.make(count, dark_us), self.session.board_s() + 0.05, ahead_s)

    def live(self, count, patience_s):
        """Run one session from HELLO to its end: arm and stream under faults."""
        session = self.session
        try:
            session.connect()
            if self.armed():
                job = self.begin(count)
                self.until(lambda: job.is_finished or session.board.state in ("DISARMED", "FAULT"), patience_s)
        except LinkError:
            session.disconnect()
        else:
            session.close()
