"""The panel's cost: pixels raised to their height per second over an hour, at two room temperatures.

Frames follow each other without a pause in virtual time, trimmed by the limiter where they must be. "without": a panel
that stays at the room's temperature.
"""

from dataclasses import replace

import numpy as np
from measuring import build_frames

from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.cap_checks import compute_panel_k
from optodrive.planning.limiter.limiter import shift_state
from optodrive.planning.pipeline import plan_sequence

ROOMS_C = (23.0, 30.0)
FULL_SHARE = 0.9
"""Share of the requested height from which a pixel counts as raised."""
WAIT_S = 0.01
COLD_PANEL = {"resistance_k_per_w": 1e-3, "capacity_j_per_k": 1e5}
FINGERTIP = [700 + 39 * row + column for row in range(5) for column in range(5)]
OPTIONS = {
    "--hours": {"type": float, "default": 1.0, "help": "time that is simulated"},
    "--display": {"help": "only cases of this display"},
    "--rooms": {"type": float, "nargs": "+", "default": ROOMS_C, "help": "temperatures of the room, °C"},
    "--warm": {"action": "store_true", "help": "begin with the panel as warm as full power makes it"},
}
CASES = (
    ("display-1511", "all pixels", None, 50.0),
    ("display-1511", "all pixels", None, 100.0),
    ("display-1511", "25 pixels under a fingertip", FINGERTIP, 50.0),
    ("display-437", "all pixels", None, 50.0),
    ("display-357", "all pixels", None, 50.0),
    ("display-16", "all pixels", None, 50.0),
    ("display-1", "its pixel", None, 50.0),
)


def build_display(name, room_c, has_panel):
    """Build the display of a shipped configuration in a room."""
    config = load_config(name).model_copy(update={"ambient_c": room_c})
    if not has_panel:
        config = config.model_copy(update={"panel": config.panel.model_copy(update=COLD_PANEL)})
    return DisplayModel.from_config(config)


def measure_rate(display, pixels, height_um, duration_s, is_warm):
    """Show one frame after the other. Return the raised pixels per second, and the panel's bound at the end, K.

    is_warm: begin with the panel as warm as permanent light of full power makes its bound
    """
    target_m = np.zeros(len(display.pixels))
    target_m[slice(None) if pixels is None else pixels] = height_um * 1e-6
    sequence = build_frames([target_m], duration_s)
    heat, budget = display.build_cold_state()
    if is_warm:
        bound = display.budget.heat
        budget = replace(budget, panel_k=bound.panel_k_per_j * bound.panel_tau_s * bound.power_max_w.sum())
    now_s, raised = 0.0, 0
    while now_s < duration_s:
        planned = plan_sequence(display, sequence, heat, budget)
        # A pixel that is still up needs no light: the next frame follows after a moment.
        end_s = float((planned.plan.start_s + planned.plan.width_s).max(initial=WAIT_S))
        raised += int(np.count_nonzero(planned.predicted_m >= FULL_SHARE * height_um * 1e-6))
        heat, budget = planned.heat.copy_shifted(-end_s), shift_state(planned.budget, -end_s)
        now_s += end_s
    return raised / now_s, compute_panel_k(budget, display.budget, budget.at_s)


def measure(hours=1.0, display=None, rooms=ROOMS_C, warm=False):
    for name, what, pixels, height_um in CASES:
        for room_c in rooms if display in (None, name) else ():
            frames = pixels, height_um, 3600.0 * hours
            without, _ = measure_rate(build_display(name, room_c, False), *frames, False)
            rate, panel_k = measure_rate(build_display(name, room_c, True), *frames, warm)
            case = f"{name}, {what} to {height_um:g} µm, room at {room_c:g} °C"
            yield f"{case}: pixels per second without a panel", without, "1/s"
            yield f"{case}: pixels per second", rate, "1/s"
            yield f"{case}: panel up to", panel_k, "K"
