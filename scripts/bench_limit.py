"""The limiter alone: a full frame, and 1,000,000 pulses in batches with a continuous budget state."""

import time

from bench_plan import build_full_frame, schedule_batches
from measuring import measure_median_cpu_s

from optodrive.planning.limiter.limiter import limit, shift_state
from process_memory import read_memory_mib  # of the tests


def measure():
    for height_um in (400, 50):
        display, sequence, heat, state = build_full_frame(height_um)
        batch = next(schedule_batches(display, sequence, heat))
        limit_s = measure_median_cpu_s(lambda: limit(batch, state, display.budget))
        yield f"{height_um} µm: full frame of 1,511 pulses", 1e3 * limit_s, "ms"
    period_s = float(batch.start_s[-1] + batch.width_s[-1]) + 1e-3
    samples_mib, count, begin_s = [], 0, time.process_time()
    while count < 1_000_000:
        state = shift_state(limit(batch, state, display.budget)[1], -period_s)
        count += len(batch)
        samples_mib.append(read_memory_mib("self")[1])
    yield "1,000,000 pulses, frame after frame", time.process_time() - begin_s, "s"
    yield "memory after 10,000 pulses", samples_mib[7], "MiB"
    yield "memory after all pulses", samples_mib[-1], "MiB"
