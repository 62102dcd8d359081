"""Several stages over one display: the time of a plan against light ÷ stages + moves, and planning time.

Beside it the bound that no plan can undercut in which each pixel keeps its stage: its pulses are not divided. Moves are
the settling times of the plan, per stage; light is the beam-on time of its pulses. The caps are those of the shipped
configurations, and the temperatures are those of an integrator that shares no code with the limiter.
"""

import statistics
import time

import numpy as np
from measuring import build_frames, measure_times_s

from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.device.config_file import load_config
from optodrive.device.config_sections import StageSection
from optodrive.device.panel import Neighbours
from optodrive.physics.parameters import load_parameters
from optodrive.planning.budget_setup import build_nominal_model, build_nominal_panel
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli.pattern_registry import build_pattern
from reference_models.thermal_display import build_true_display

RUNS = 5
STAGE_COUNTS = (1, 2, 3, 4)
DISPLAYS = ("display-1511", "display-437")
OPTIONS = {"--display": {"choices": DISPLAYS, "help": "only this one"}}
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


def measure(display=None):
    for name in (display,) if display else DISPLAYS:
        displays = [build_display(name, count) for count in STAGE_COUNTS]
        for case, targets_m in build_cases(displays[0]):
            sequence, single_s = build_frames(targets_m, 100.0), None
            for staged in displays:
                planned = plan_sequence(staged, sequence, *staged.build_cold_state())
                plan, stages = planned.plan, len(staged.scan_heads)
                planning_s = statistics.median(
                    measure_times_s(
                        lambda: plan_sequence(staged, sequence, *staged.build_cold_state()), RUNS, time.process_time
                    )
                )
                single_s = single_s or planning_s
                span_s = float((plan.start_s + plan.width_s).max()) - planned.lead_in_s
                own_moves_s = float(plan.settling_s.sum()) - stages * planned.lead_in_s
                floor_s = (float(plan.width_s.sum()) + own_moves_s) / stages
                what = f"{name}, {case}, {stages} stages"
                yield f"{what}: pulses", len(plan), "1"
                yield f"{what}: time of the plan", span_s, "s"
                yield f"{what}: time over light ÷ stages + moves", span_s / floor_s, "1"
                yield f"{what}: its bound, of pixels that keep their stage", compute_bound(plan, stages), "1"
                yield f"{what}: CPU time of planning over that of one stage", planning_s / single_s, "1"
                yield f"{what}: largest temperature over its cap", compute_cap_use(staged, plan), "1"
