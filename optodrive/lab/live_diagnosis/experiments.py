"""Experiments of a campaign as plans that the limiter passes: the first ones, and those that a diagnosis proposes."""

from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import sha256

import numpy as np

from optodrive.core.errors import RefusedError
from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.core.types.discrepancy import NextExperiment
from optodrive.core.types.plans import LimitedPlan
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.device.config import Config, build_pixel_layout
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence

LEAD_S = 0.02
"""Time that is recorded before the first pulse."""
TAIL_S, TRAIN_TAIL_S = 0.1, 0.3
"""Time that is recorded after the last pulse of an experiment; a train also warms the walls."""
TRAIN_PULSES = 10
"""Number of pulses from which an experiment counts as a train."""
LADDER = (0.25, 0.5, 1.0)
"""Powers of the pulses of the ladder, relative to the largest."""
WIDTHS_S = (0.002, 0.006, 0.02)
LADDER_REST_S, WIDTHS_REST_S = 0.11, 0.08
"""Gate-off time between two pulses, in which the absorber cools."""
TRAIN_WIDTH_S, TRAIN_GAP_S, TRAIN_COUNT = 0.02, 0.04, 25
FIRST_ORDER = ("ladder", "widths", "train", "ladder", "widths", "train", "ladder", "widths")
"""Experiments of the first campaign in their order: repeats lie apart, and show what drifts or ages."""
POWER_STEP, POWER_MIN = 0.9, 0.05
"""Factor by which the power of an experiment above a cap is reduced, and the smallest one that is tried."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """An experiment on one pixel.

    pulses: [n, 4] start_s, width_s, power_w, pixel as planned, the first at LEAD_S; span_s: time that is recorded
    """

    name: str
    plan: LimitedPlan
    pulses: FloatArray
    pixel: int
    span_s: float

    def __post_init__(self) -> None:
        freeze_arrays(self)


def find_pixels(config: Config) -> tuple[int, int]:
    """Return the pixel nearest to the centre of a display, and the pixel nearest to that one, itself if it is alone."""
    layout = build_pixel_layout(config.display)
    centre = int(np.argmin(np.hypot(layout.x_m, layout.y_m)))
    distance_m = np.hypot(layout.x_m - layout.x_m[centre], layout.y_m - layout.y_m[centre])
    order = np.argsort(distance_m, kind="stable")
    return centre, int(order[min(1, len(order) - 1)])


def plan_first_experiments(display: DisplayModel, pixel: int, neighbour: int) -> dict[str, Experiment]:
    """Plan the first campaign, by the names of FIRST_ORDER.

    A ladder of powers held as long as the caps allow, then the neighbour alone; a series of widths; and a train.
    """
    laser, limits = display.config.laser, display.config.limits
    hold_s = min(0.05, limits.pulse_width_max_s)
    ladder = [(hold_s, share * laser.max_power_w, pixel, LADDER_REST_S) for share in LADDER]
    if neighbour != pixel:
        ladder.append((hold_s, laser.max_power_w, neighbour, LADDER_REST_S))
    widths = [(min(width_s, hold_s), laser.max_power_w, pixel, WIDTHS_REST_S) for width_s in WIDTHS_S]
    train = [(min(TRAIN_WIDTH_S, hold_s), laser.max_power_w, pixel, TRAIN_GAP_S)] * TRAIN_COUNT
    return {
        name: plan_experiment(display, name, _place(rows), pixel)
        for name, rows in (("ladder", ladder), ("widths", widths), ("train", train))
    }


def plan_proposal(display: DisplayModel, proposal: NextExperiment) -> Experiment:
    """Plan an experiment that a diagnosis proposes. Equal ones have equal names, by which they are repeats."""
    digest = sha256(np.round(proposal.pulses * [1e6, 1e6, 1e4, 1.0]).tobytes()).hexdigest()[:6]
    return plan_experiment(display, f"next-{digest}", proposal.pulses, proposal.pixel)


def plan_experiment(display: DisplayModel, name: str, pulses: FloatArray, pixel: int) -> Experiment:
    """Plan pulses [n, 4], with less power where a cap of the cold display asks for it.

    Raises RefusedError if even a small fraction of the power exceeds a cap.
    """
    share = 1.0
    while True:
        try:
            plan = _plan_pulses(display, pulses * [1.0, 1.0, share, 1.0])
            break
        except RefusedError:
            share *= POWER_STEP
            if share < POWER_MIN:
                raise
    planned = np.column_stack([plan.start_s - plan.start_s[0] + LEAD_S, plan.width_s, plan.power_w, plan.pixel])
    tail_s = TRAIN_TAIL_S if len(planned) >= TRAIN_PULSES else TAIL_S
    return Experiment(name, plan, planned, pixel, float(planned[-1, 0] + planned[-1, 1]) + tail_s)


def _plan_pulses(display: DisplayModel, pulses: FloatArray) -> LimitedPlan:
    """Plan single pulses, of whole PWM periods. Raise RefusedError if one exceeds a cap."""
    pwm_hz = display.config.laser.pwm_hz
    trains = []
    for start_s, width_s, power_w, pixel in pulses.tolist():
        width_s = max(1, round(width_s * pwm_hz)) / pwm_hz
        trains.append(PulseTrain(int(pixel), start_s - pulses[0, 0], width_s, width_s, 0.01, power_w))
    return plan_sequence(display, FrameSequence((), tuple(trains)), *display.build_cold_state(), policy="refuse").plan


def _place(rows: Iterable[tuple[float, float, int, float]]) -> FloatArray:
    """Return pulses [n, 4] of rows of width, power, pixel and the rest that follows."""
    out, start_s = [], LEAD_S
    for width_s, power_w, pixel, rest_s in rows:
        out.append((start_s, width_s, power_w, pixel))
        start_s += width_s + rest_s
    return np.array(out)
