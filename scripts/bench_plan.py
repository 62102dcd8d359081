"""Planning, limiting and predicting a full 1,511-pixel frame, and the whole command. CPU times, medians of seven."""

import json
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from measuring import build_display, build_frames, measure_median_cpu_s, measure_times_s

from optodrive.planning.limiter.limiter import limit
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler.scheduler import Scheduler


def build_full_frame(height_um=50.0):
    """Return a display, a sequence of one frame with the same target on every pixel, and heat and budget when cold."""
    display = build_display()
    sequence = build_frames([np.full(len(display.layout), height_um * 1e-6)])
    return display, sequence, *display.build_cold_state()


def schedule_batches(display, sequence, heat):
    """Return an iterator over the batches of a plan without the limiter."""
    scheduler = Scheduler(display.scan_heads, display.build_assignment(sequence), sequence, display.build_cold_heat)
    return scheduler.run(heat.copy(), lambda batch: batch)


def read_children_cpu_s():
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def measure():
    for height_um in (50, 100, 400):
        display, sequence, heat, budget = build_full_frame(height_um)
        planned = plan_sequence(display, sequence, heat, budget)
        batch, count = next(schedule_batches(display, sequence, heat)), len(planned.plan)
        for what, work in (
            ("pulses planned", lambda: list(schedule_batches(display, sequence, heat))),
            ("pulses limited", lambda: limit(batch, budget, display.budget)),
            ("planned, limited and predicted", lambda: plan_sequence(display, sequence, heat, budget)),
        ):
            yield f"{height_um} µm: {what} per second", count / measure_median_cpu_s(work), "1/s"
        yield f"{height_um} µm: beam-on fraction of the plan", planned.plan.width_s.sum() / planned.duration_s, "1"
        yield f"{height_um} µm: pixels shown per second of the plan", count / planned.duration_s, "1/s"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.json"
        path.write_text(json.dumps({"frames": [{"show_at_s": 0, "duration_s": 10, "target_um": [50.0] * 1511}]}))
        command = [Path(sys.executable).with_name("optodrive"), "plan", path, "--config", "display-1511"]
        cpu_s = measure_times_s(
            lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL), clock=read_children_cpu_s
        )
    yield "optodrive plan, 1,511 pixels at 50 µm, whole command", statistics.median(cpu_s), "s CPU"
