"""The page on 1,511 pixels while a pattern plays: its frame rate in Chromium, and the cost of snapshots."""

import time
from itertools import count, pairwise
from statistics import median

import numpy as np
from measuring import build_display, measure_times_s, running_daemon, to_ms

from optodrive.daemon.engine.telemetry_events import EmittedPulses, LiveThermalState
from optodrive.planning.pipeline import warm_up

SECONDS, SNAPSHOTS = 12, 300
PERIOD_S = 20.0


def measure_snapshots():
    """Measure the wall time of a snapshot of heights and of the budget, with half of the pixels driven."""
    display = build_display()
    warm_up(display)
    live, pixel = LiveThermalState(display), np.arange(0, 1511, 2)
    size, none = len(pixel), np.zeros(len(pixel))
    start_s = 5e-3 * np.arange(size)
    live.apply(EmittedPulses(pixel, start_s, np.full(size, 4e-3), np.full(size, 2.0), none, none, none.astype(int)))
    for what, compute_snapshot in (("all heights", live.state_at), ("the budget", live.compute_usage)):
        times = (5e-3 * size + 0.033 * k for k in count())
        taken_s = measure_times_s(lambda: compute_snapshot(next(times)), SNAPSHOTS)
        yield f"snapshot of {what}", to_ms(taken_s), "ms"


def measure():
    from window import PageVisit, launch_chromium  # of the tests

    yield from measure_snapshots()
    with running_daemon("display-1511") as (_, daemon), launch_chromium() as browser:
        page = PageVisit(browser, daemon.url).open()
        daemon.arm()
        for _ in range(2):
            daemon.call("POST", "/v1/patterns/all", json={"height_um": 30, "seconds": PERIOD_S})
        counted = []
        for _ in range(SECONDS + 1):
            counted.append((time.monotonic(), int(page.locator("#display").get_attribute("data-frames"))))
            time.sleep(1.0)
        state = daemon.state()
    rates = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(counted)]
    yield "frames per second, 1,511 pixels, median", median(rates), "1/s"
    yield "frames per second, worst second", min(rates), "1/s"
    yield "pulses executed", state["totals"]["executed"], "1"
    yield "underruns", state["board"]["underruns"], "1"
    yield "longest stall of the daemon's loop", state["link"]["longest_stall_ms"], "ms"
