"""Host that arms a board and keeps it emitting until it ends: python emitting_host.py PORT LEASE_S.

It prints lines of JSON: `clock_s`, board time minus this machine's monotonic time, with its uncertainty `within_s`;
`emitted`, index and tick of an executed point. After a line on stdin it closes the port without a message to the board,
prints `closed_s`, the time just before, and waits until stdin ends.
"""

import json
import select
import sys
import time

import numpy as np

from optodrive.core.clock import MonotonicClock
from optodrive.core.scheduling import LIGHT, set_realtime_priority
from optodrive.device.config import Config
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import FrameDecoder
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.serial_port import SerialPort

PLACES = np.array([(30_500, 32_000), (34_000, 32_000), (30_500, 33_500), (34_000, 33_500)])
POINTS, DARK_US, ON_US, DUTY = 4000, 600, 8000, 2000
AHEAD_LEASES = 1.5
"""Points ahead, in leases: the lease ends the emission of a stopped host. More would delay the LEASE behind them."""
BAUD = 115_200
"""Rate that an emulated UART receives reliably. On a faster line a burst would delay the LEASE behind it."""
PATIENCE_S = 4.0


def print_json(**fields):
    print(json.dumps(fields), flush=True)


class RecordingPort(SerialPort):
    """Serial port that keeps the first report of executed points."""

    def __init__(self, port):
        super().__init__(port, BAUD)
        self.report = None
        self._theirs = FrameDecoder()

    def read(self, timeout_s):
        data = super().read(timeout_s)
        for frame in self._theirs.feed(data):
            if frame.type == m.Executed.TYPE and self.report is None:
                self.report = m.parse_message(frame.type, frame.body)
        return data


def until(session, condition, patience_s=PATIENCE_S):
    """Step the session until condition(). Raise SystemExit on a timeout, for example after the lease expired."""
    give_up_s = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > give_up_s:
            sys.exit(f"{session.board} after {patience_s} s")
        session.step(0.002, renew_lease=True)


def train():
    rows = np.arange(POINTS)
    columns = [np.full(POINTS, value) for value in (DARK_US, ON_US, DUTY)]
    return WirePoints(np.column_stack([PLACES[rows % len(PLACES)], *columns]).astype(np.uint16), rows)


def main(name, lease_s):
    set_realtime_priority(LIGHT)  # as the daemon's loop does
    table = load_config("display-16").model_dump()
    table["board"] |= {"baud": BAUD, "lease_s": lease_s}
    port = RecordingPort(name)
    session = BoardSession(port, MonotonicClock(), build_board_requirements(Config.model_validate(table)))
    session.connect()
    if session.board.state == "FAULT":
        session.disarm()
        until(session, lambda: session.board.state == "DISARMED")
    session.arm()
    until(session, lambda: session.is_ready)
    print_json(
        clock_s=session.board_s() - time.monotonic(), within_s=session.collect_link_stats()["round_trip_ms"] * 0.5e-3
    )
    job = session.begin(train(), session.board_s() + 0.05, AHEAD_LEASES * lease_s)
    ahead = int(AHEAD_LEASES * lease_s / (DARK_US + ON_US) * 1e6)
    until(session, lambda: port.report is not None and job.next_to_send >= ahead)
    print_json(emitted={"index": port.report.first_index, "tick": port.report.records[0][0]})
    until(session, lambda: select.select([sys.stdin], [], [], 0)[0])
    print_json(closed_s=time.monotonic())
    session.disconnect()
    sys.stdin.read()


main(sys.argv[1], float(sys.argv[2]))
