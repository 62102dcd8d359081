"""Memory of the daemon's processes while full frames of 1,511 pixels stream."""

import sys
import threading
from pathlib import Path

import pytest

from optodrive.daemon.engine.active_plan import RECORDS_MAX
from process_memory import list_processes, read_memory_mib
from rig import Board, Daemon, wait_for

SCRIPTS = Path(__file__).parents[2] / "scripts"
sys.path.append(str(SCRIPTS))

from frame_stream import NAME, FrameStream  # noqa: E402 - a script
from measuring import LEASE_S  # noqa: E402

ALL_MAX_MIB = 260.0
GROWTH_MAX_MIB = 6.0
"""Largest growth of a process once it holds all the records that it may, MiB."""


@pytest.mark.slow
def test_a_stream_takes_no_further_memory_once_the_oldest_plans_are_dropped(tmp_path):
    board = Board(tmp_path, limits=f"lease_ms = {LEASE_S * 1e3:.0f}\n")
    daemon = Daemon(tmp_path, board.port, NAME, lease_s=LEASE_S, is_fresh=True)
    stream = FrameStream(daemon, float("inf"))
    thread = threading.Thread(target=stream.run)
    thread.start()

    def measure_after(plans):
        wait_for(lambda: stream.statuses["planned"] >= plans, f"{plans} plans")
        return {name: read_memory_mib(pid)[0] for name, pid in list_processes(daemon.process.pid).items()}

    try:
        before, after = (measure_after(plans) for plans in (int(1.5 * RECORDS_MAX), 3 * RECORDS_MAX))
    finally:
        stream.stop()
        thread.join()
        daemon.stop()
        board.stop()
    assert sum(after.values()) < ALL_MAX_MIB, after
    growth_mib = {name: mib - before.get(name, mib) for name, mib in after.items()}
    assert max(growth_mib.values()) < GROWTH_MAX_MIB, growth_mib
