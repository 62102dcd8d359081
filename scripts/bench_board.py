"""The board session with the simulated board in virtual time. Medians of seven runs, CPU time."""

from bench_plan import build_full_frame
from measuring import measure_median_cpu_s

from optodrive.link.simulator.virtual_run import execute
from optodrive.planning.pipeline import plan_sequence


def measure():
    display, *request = build_full_frame()
    planned = plan_sequence(display, *request)
    seconds = measure_median_cpu_s(lambda: execute(display, planned))
    yield "pulses through session and simulated board per second", len(planned.plan) / seconds, "1/s"
    yield "times real time", planned.duration_s / seconds, "×"
