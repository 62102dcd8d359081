"""The page on 1,511 pixels while a full pattern plays: frames a second as it counts them, and what looks cost."""

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
    """Wall time of one look at heat and of one at the budget, half of the display lit."""
    import numpy as np

    from optodrive.daemon.engine.display_snapshot import ExecutedBatch, LiveThermalState
    from optodrive.device.config import load_config
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
        ("a look at all heights", live.state_at),
        ("a look at the budget", live.compute_usage),
    ):
        taken_s = []
        for k in range(SNAPSHOTS):
            begin_s = time.perf_counter()
            compute_snapshot(5e-3 * count + 0.033 * k)
            taken_s.append(time.perf_counter() - begin_s)
        rows.append((what, 1e3 * median(taken_s), "ms"))
    return rows


def measure_page():
    """Frames that the page painted in each second, and what the daemon's loop bore of it."""
    from rig import Board, Daemon
    from window import Visit, chromium

    with tempfile.TemporaryDirectory() as folder:
        board = Board(Path(folder))
        daemon = None
        try:
            daemon = Daemon(Path(folder), board.port, name="display-1511")
            with chromium() as browser:
                page = Visit(browser, daemon.url).open()
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
        ("frames a second, 1,511 pixels, median", median(rates), "1/s"),
        ("frames a second, the worst second", min(rates), "1/s"),
        ("pulses executed meanwhile", state["totals"]["executed"], "1"),
        ("underruns meanwhile", state["board"]["underruns"], "1"),
        ("longest stall of the daemon's loop", state["link"]["longest_stall_ms"], "ms"),
    ]


def _read_frame_count(page):
    return int(page.locator("#display").get_attribute("data-frames"))


def bench_page():
    """Looks, then the page itself."""
    return measure_snapshots() + measure_page()
