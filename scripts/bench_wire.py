"""Encoding of a limited plan, and the verification that decodes it. Medians of seven runs, CPU time."""

from bench_plan import build_full_frame
from measuring import measure_median_cpu_s

from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import decode, quantise
from optodrive.planning.limiter.limiter import verify
from optodrive.planning.pipeline import plan_sequence


def measure():
    display, sequence, heat, budget = build_full_frame()
    plan = plan_sequence(display, sequence, heat, budget).plan
    scale = build_board_requirements(display.config).scale
    points = quantise(plan, scale)
    payload = points.encode_payload()

    def run_verification():
        decoded = decode(payload, scale)
        verify(plan, points.row[decoded.index], decoded, budget, display.budget)

    yield "pulses quantised per second", len(plan) / measure_median_cpu_s(lambda: quantise(plan, scale)), "1/s"
    yield "pulses decoded and verified per second", len(plan) / measure_median_cpu_s(run_verification), "1/s"
    yield "bytes per pulse", len(payload) / len(plan), "B"
