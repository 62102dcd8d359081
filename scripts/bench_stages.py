"""Benchmark of several stages over one display: the time of a plan against light ÷ stages + moves, and planning time.

Beside it the bound that no plan can undercut in which each pixel keeps its stage: its pulses are not divided. Moves are
the settling times of the plan, per stage; light is the beam-on time of its pulses. The caps are those of the shipped
configurations, and the temperatures are those of an integrator that shares no code with the limiter.
"""

import argparse
import statistics
import sys
import time
from pathlib import Path

import numpy as np

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.core.units import ZERO_CELSIUS_K
from optodrive.device.config_file import load_config
from optodrive.device.config_sections import StageSection
from optodrive.device.neighbours import Neighbours
from optodrive.physics.parameters import load_parameters
from optodrive.planning.budget_setup import build_nominal_model, build_nominal_panel
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli.pattern_registry import build_pattern

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from reference_models.thermal_display import build_true_display

RUNS = 5
STAGE_COUNTS = (1, 2, 3, 4)
TEXT = "optodrive draws"
PAGES = "the quick brown fox jumps over the lazy dog and reads a page of braille with two fingers on a display of light"


def build_display(name, count):
    """Return a display with that many equal stages."""
    config = load_config(name)
    stages = tuple(
        StageSection(name=f"stage {number}", laser=config.laser, scanner=config.scanner, board=config.board)
        for number in range(count)
    )
    return DisplayModel.from_config(config.model_copy(update={"stages": stages if count > 1 else ()}))


def build_cases(display):
    """Yield the name of each case and its sequence. Frames are requested at once, one after the other."""
    count, rng = len(display.pixels), np.random.default_rng(7)
    half = rng.choice(count, count // 2, replace=False)
    heights_m = np.zeros(count)
    heights_m[half] = rng.uniform(20e-6, 150e-6, len(half))
    yield "full, 50 µm", [np.full(count, 50e-6)]
    yield "half at random, 20 to 150 µm", [heights_m]
    yield "braille, ten pages of four words", list(build_pages(display, 4, 100.0))
    yield "braille, a page per word", list(build_pages(display, 1, 150.0))
    x_m, y_m = display.layout.x_m, display.layout.y_m
    offset_m = np.abs(np.hypot(x_m, y_m)[None, :] - np.linspace(0.2, 0.9, 8)[:, None] * np.hypot(x_m, y_m).max())
    yield "rings, twice", [*np.where(offset_m < 0.7 * display.config.display.pitch_m, 100e-6, 0.0)] * 2
    angle, rng = np.arctan2(y_m, x_m), np.random.default_rng(5)
    yield "tenth at random, eight frames", [np.where(rng.random(count) < 0.1, 150e-6, 0.0) for _ in range(8)]
    dots_m = [np.where(rng.random(count) < 0.1, rng.uniform(20e-6, 150e-6, count), 0.0) for _ in range(20)]
    yield "tenth at random, 20 to 150 µm, 20 frames", dots_m
    turn = np.abs(np.angle(np.exp(1j * (angle[None, :] - np.arange(16)[:, None] * np.pi / 8))))
    is_bar = (turn < 0.2) & (np.hypot(x_m, y_m) > display.config.display.pitch_m)
    yield "rotating bar, twice", [*np.where(is_bar, 100e-6, 0.0)] * 2
    for name, pattern, given in (
        ("braille, one page", "text", {"text": TEXT, "height_um": 150}),
        ("moving edge", "edge", {"height_um": 100}),
    ):
        yield name, [frame.target_m for frame in build_pattern(pattern, given, display.config).frames]


def build_pages(display, count, height_um):
    """Yield the targets of pages of a number of words each, of which every second begins one."""
    words = PAGES.split()
    for first in range(0, len(words) - count, 2 if count > 1 else 1):
        given = {"text": " ".join(words[first : first + count]), "height_um": height_um}
        yield build_pattern("text", given, display.config).frames[0].target_m


def compute_bound(plan, stages):
    """Return the bound that pixels set which keep their stage, over light ÷ stages + moves."""
    pixel_s = np.sort(np.bincount(plan.pixel, plan.width_s + plan.settling_s))[::-1]
    largest_s = pixel_s[::stages]  # of the largest j k + 1, one stage has j + 1
    return max(1.0, ((np.arange(len(largest_s)) + 1) * largest_s).max() * stages / pixel_s.sum())


def build_sequence(targets_m):
    """Return frames without a pause between them."""
    return FrameSequence(tuple(TactileFrame(f"f{k}", 1e-3 * k, 100.0, target) for k, target in enumerate(targets_m)))


def compute_cap_use(display, plan):
    """Return the largest temperature of absorbers, walls and touch surfaces over its cap, in the integrator."""
    config = display.config
    parameters = load_parameters(config.pixel_model.parameters)
    panel = build_nominal_panel(config, parameters, display.pixels)
    neighbours = Neighbours.from_display(config.display)
    model = build_nominal_model(parameters, display.pixels, neighbours, config.ambient_c + ZERO_CELSIUS_K, panel=panel)
    absorber_k, _, wall_k, touch_k, _ = build_true_display(model).peaks(plan, dark_s=1.0)
    caps = display.budget.caps
    return max(absorber_k / caps.absorber_k, wall_k / caps.wall_k, touch_k / caps.touch_k)


def measure_plan(display, sequence):
    """Return the plan, its time over light ÷ stages + moves, that time, and the median CPU time of planning, s."""
    times_s = []
    for _ in range(RUNS):
        begin_s = time.process_time()
        planned = plan_sequence(display, sequence, *display.build_cold_state())
        times_s.append(time.process_time() - begin_s)
    plan, stages = planned.plan, len(display.scan_heads)
    span_s = float((plan.start_s + plan.width_s).max()) - planned.lead_in_s
    own_moves_s = float(plan.settling_s.sum()) - stages * planned.lead_in_s
    floor_s = (float(plan.width_s.sum()) + own_moves_s) / stages
    return plan, span_s / floor_s, span_s, statistics.median(times_s)


def main():
    parser = argparse.ArgumentParser(prog="scripts/bench stages", description=__doc__)
    parser.add_argument("--display", choices=("display-1511", "display-437"), help="only this one")
    options = parser.parse_args()
    columns = f"{'k':>2}{'pulses':>8}{'time s':>9}{'over floor':>12}{'bound':>8}{'planning':>10}{'caps':>7}"
    print(f"{'display':<13}{'case':<44}{columns}")
    for name in (options.display,) if options.display else ("display-1511", "display-437"):
        displays = [build_display(name, count) for count in STAGE_COUNTS]
        for case, targets_m in build_cases(displays[0]):
            sequence, single_s = build_sequence(targets_m), None
            for display in displays:
                plan, over, span_s, planning_s = measure_plan(display, sequence)
                single_s = planning_s if single_s is None else single_s
                stages, used = len(display.scan_heads), compute_cap_use(display, plan)
                row = f"{stages:>2}{len(plan):>8}{span_s:>9.3f}{over:>12.4f}{compute_bound(plan, stages):>8.4f}"
                print(f"{name:<13}{case:<44}{row}{planning_s / single_s:>10.2f}{used:>7.2f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
