"""Benchmark of the page on 1,511 pixels while a pattern plays: its frame rate, and the cost of snapshots."""

import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / folder) for folder in ("system", "browser")]

SECONDS, SNAPSHOTS = 12, 300
PERIODS_S = 20.0


def measure_snapshots():
    """Measure the wall time of a snapshot of heights and of the budget, with half of the pixels driven."""
    import numpy as np

    from optodrive.daemon.engine.display_snapshot import ExecutedBatch, LiveThermalState
    from optodrive.device.config_file import load_config
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.pipeline import warm_up

    display = DisplayModel.from_config(load_config("display-1511"))
    warm_up(display)
    live, pixel = LiveThermalState(display), np.arange(0, 1511, 2)
    count, none = len(pixel), np.zeros(len(pixel))
    start_s = 5e-3 * np.arange(count)
    live.apply(ExecutedBatch(None, pixel, pixel, start_s, np.full(count, 4e-3), np.full(count, 2.0), none, none))
    rows = []
    for what, compute_snapshot in (
        ("snapshot of all heights", live.state_at),
        ("snapshot of the budget", live.compute_usage),
    ):
        taken_s = []
        for k in range(SNAPSHOTS):
            begin_s = time.perf_counter()
            compute_snapshot(5e-3 * count + 0.033 * k)
            taken_s.append(time.perf_counter() - begin_s)
        rows.append((what, 1e3 * median(taken_s), "ms"))
    return rows


def measure_page():
    """Measure the frames painted per second, and the longest stall of the daemon's loop."""
    from rig import Board, Daemon
    from window import PageVisit, launch_chromium

    with tempfile.TemporaryDirectory() as folder:
        board = Board(Path(folder))
        daemon = None
        try:
            daemon = Daemon(Path(folder), board.port, name="display-1511")
            with launch_chromium() as browser:
                page = PageVisit(browser, daemon.url).open()
                daemon.arm()
                daemon.call("POST", "/v1/patterns/all", json={"height_um": 30, "seconds": PERIODS_S})
                daemon.call("POST", "/v1/patterns/all", json={"height_um": 30, "seconds": PERIODS_S})
                counted = [(time.monotonic(), _read_frame_count(page))]
                for _ in range(SECONDS):
                    time.sleep(1.0)
                    counted.append((time.monotonic(), _read_frame_count(page)))
                state = daemon.state()
        finally:
            if daemon is not None:
                daemon.stop()
            board.stop()
    rates = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(counted)]
    return [
        ("frames per second, 1,511 pixels, median", median(rates), "1/s"),
        ("frames per second, worst second", min(rates), "1/s"),
        ("pulses executed", state["totals"]["executed"], "1"),
        ("underruns", state["board"]["underruns"], "1"),
        ("longest stall of the daemon's loop", state["link"]["longest_stall_ms"], "ms"),
    ]


def _read_frame_count(page):
    return int(page.locator("#display").get_attribute("data-frames"))


def bench_page():
    """Return the rows of the table."""
    return measure_snapshots() + measure_page()
