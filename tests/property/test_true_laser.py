"""Heights and caps with lasers as they are: with a curve and a threshold, or on and off.

The judge takes the gates from the board's log, and the light from the true laser's own curve, which it reads by itself;
it integrates pixels and display by Runge-Kutta.
"""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.clock import ManualClock
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.link.board_setup import build_board_settings, build_scales
from optodrive.link.protocol import quantisation
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.guards import build_settings
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from reference_models.nominal_pixel import height_um
from reference_models.shipped_display import build_model, build_worst_factors
from reference_models.thermal_display import TOUCHED, build_true_display

CONFIG = DISPLAYS["display-16"].config
FULL_W = CONFIG.laser.max_power_w
LATE_AND_DROOPING = [[0.0, 0.0], [0.12, 0.0], [0.2, 0.31], [0.4, 1.1], [0.7, 2.0], [1.0, FULL_W]]
EARLY = [[0.0, 0.0], [0.1, 0.05], [0.3, 0.25], [0.6, 0.9], [1.0, FULL_W]]
LASERS = {
    "proportional": {},
    "threshold": {"threshold_w": 1.0},
    "late_and_drooping": {"curve": LATE_AND_DROOPING, "threshold_w": 0.31},
    "microseconds": {"curve": EARLY, "whole_periods": False},
    "on_off": {"modulation": "on_off"},
}
TRAIN_PIXEL, SAMPLE_S, RISING_S = 12, 5e-5, 0.02
SLACK = 1e-3
"""Relative error of a height by rounding to a microsecond or to a step of the duty."""


def build_display(changes):
    """Return the display with another laser, parsed as from a file."""
    table = CONFIG.model_dump()
    return DisplayModel.from_config(type(CONFIG).model_validate(table | {"laser": table["laser"] | changes}))


def emit_w(changes, duty):
    """Return the light of the true laser, W, between the rows of its table."""
    if changes.get("modulation") == "on_off":
        return np.where(duty > 0.5, FULL_W, 0.0)
    rows = changes.get("curve", [[0.0, 0.0], [1.0, FULL_W]])
    power_w = np.zeros_like(duty)
    for (low, low_w), (high, high_w) in pairwise(rows):
        inside = (duty > low) & (duty <= high)
        power_w[inside] = low_w + (duty[inside] - low) / (high - low) * (high_w - low_w)
    return np.where(power_w < changes.get("threshold_w", 0.0), 0.0, power_w)


def play(display, plan):
    """Play a plan on a simulated board and return its log of pulses."""
    log, clock, (settings,) = [], ManualClock(1.0), build_board_settings(display.config)
    core = BoardCore(build_settings(settings.port.own_settings), log.append, seed=3)
    boards = BoardGroup([BoardSession(MemoryLink(core, clock), clock, settings.requirements)], clock, [lambda: True])
    while not boards.connected:
        boards.step_connecting()
    boards.arm()
    while boards.state != "ARMED":
        boards.step(0.005, renew_lease=True)
    job = boards.begin(StagePoints.from_plan(plan, build_scales(display.config)), boards.board_s() + 0.05)
    while not job.is_finished:
        boards.step(0.005, renew_lease=True)
        assert boards.state in {"ARMED", "RUNNING"}, boards.board
    return [event for event in log if event["event"] == "pulse"]


def read_light(changes, pulses):
    """Return the light on each pixel by the board's log."""
    column = {name: np.array([each[name] for each in pulses], dtype=float) for name in ("on_us", "off_us", "duty")}
    code_m = 2.0 * CONFIG.scanner.focal_length_m * CONFIG.scanner.range_rad / 32767
    layout = DISPLAYS["display-16"].layout
    at_m = (np.array([[each["x"], each["y"]] for each in pulses]) - 32768) * code_m
    distance_m = np.hypot(*(at_m[:, k, None] - axis for k, axis in enumerate((layout.x_m, layout.y_m))))
    return SimpleNamespace(
        start_s=(column["on_us"] - column["on_us"][0]) * 1e-6,
        width_s=(column["off_us"] - column["on_us"]) * 1e-6,
        power_w=emit_w(changes, column["duty"] / 65535.0),
        pixel=distance_m.argmin(axis=1),
    )


def sample_sequence(seed, display):
    """Return frames of all heights on few pixels, and trains by height or by full power on others."""
    random, pixels = np.random.default_rng(seed), DISPLAYS["display-16"].pixels.elements[0]
    assert pixels.kappa_m_per_k > 0.0
    max_m = float(display.max_displacement_m.min())
    frames = []
    for number in range(3):
        target_m = np.zeros(16)
        chosen = random.choice(8, size=4, replace=False)
        target_m[chosen] = max_m * random.choice([0.002, 0.02, 0.3, 0.9], size=4) * random.uniform(0.9, 1.1, size=4)
        frames.append(TactileFrame(f"f{number}", 0.5 * number, 0.4, target_m))
    trains = (
        HeightTrain(TRAIN_PIXEL, 0.02, 1.2, random.choice([0.03, 0.08]), 0.4 * max_m),
        PulseTrain(15, 0.005, 1.2, 0.004, 0.196, FULL_W),
    )
    return FrameSequence(tuple(frames), trains)


def compute_errors_m(plan, light):
    """Return the error of the height after each pulse with a target, m, and the targets, m."""
    errors_m, targets_m = [], []
    for pixel in np.unique(light.pixel):
        mine, rows = np.flatnonzero(light.pixel == pixel), np.flatnonzero((plan.pixel == pixel) & (plan.power_w > 0.0))
        assert len(mine) == len(rows)
        pulses = np.column_stack([light.start_s[mine], light.width_s[mine], light.power_w[mine]])
        time = np.arange(0.0, pulses[-1, 0] + pulses[-1, 1] + 0.05, SAMPLE_S)
        height = 1e-6 * height_um(DISPLAYS["display-16"].pixels.elements[pixel], pulses, time)
        until_s = np.append(light.start_s[mine[1:]], np.inf)
        for row, at, until in zip(rows, mine, until_s, strict=True):
            window = (time >= light.start_s[at]) & (time <= until)
            # The first cycles of a train are on their way to the steady one, and a frame that is late may begin while
            # the membrane still rises.
            is_early = pixel == TRAIN_PIXEL and at in mine[:-3]
            rests_s = until - light.start_s[at] - light.width_s[at]
            if np.isfinite(plan.target_m[row]) and rests_s > RISING_S and not is_early:
                errors_m.append(height[window].max() - plan.target_m[row])
                targets_m.append(plan.target_m[row])
    return np.array(errors_m), np.array(targets_m)


def weakest_rise_m(changes, display):
    """Return the rise by the weakest pulse that the true laser emits, m."""
    is_on_off = changes.get("modulation") == "on_off"
    shape = (1e-6, FULL_W) if is_on_off else (1.0 / CONFIG.laser.pwm_hz, changes.get("threshold_w", 0.0))
    pulse = np.array([[0.0, *shape]])
    return 1e-6 * float(height_um(display.pixels.elements[0], pulse, np.arange(0.0, 0.05, SAMPLE_S)).max())


def judge_heights(name, changes, seed):
    """Play a sequence planned for a laser on the true one. Return whether all heights are right."""
    display = build_display(changes)
    plan = plan_sequence(display, sample_sequence(seed, display), *display.build_cold_state()).plan
    assert not plan.trimmed_j.any()
    light = read_light(LASERS[name], play(display, plan))
    if (light.power_w == 0.0).any():
        return False
    errors_m, targets_m = compute_errors_m(plan, light)
    slack_m = 0.5 * weakest_rise_m(LASERS[name], display) + SLACK * targets_m + 2e-8
    return bool((np.abs(errors_m) <= slack_m).all())


@pytest.mark.parametrize("seed", [0, pytest.param(range(1, 30), marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", LASERS)
def test_heights_are_right_with_the_true_laser(name, seed):
    for each in [seed] if isinstance(seed, int) else seed:
        assert judge_heights(name, LASERS[name], each)


@pytest.mark.parametrize(
    ("name", "ignored"),
    [
        ("late_and_drooping", {"threshold_w": 0.31}),
        ("microseconds", {"whole_periods": False}),
        ("threshold", {}),
        ("on_off", {"modulation": "pwm"}),
    ],
)
def test_a_laser_that_the_configuration_ignores_is_found(name, ignored):
    assert not judge_heights(name, ignored, 0)


def test_a_curve_that_the_encoder_ignores_is_found(monkeypatch):
    monkeypatch.setattr(quantisation, "compute_duty", lambda power_w, full_power_w, curve: power_w / full_power_w)
    assert not judge_heights("microseconds", LASERS["microseconds"], 0)


def test_a_threshold_that_the_planner_ignores_is_found(monkeypatch):
    build = DriveRange.from_config
    weak = classmethod(lambda cls, config: DriveRange(*[getattr(build(config), n) for n in FIELDS]))
    monkeypatch.setattr(DriveRange, "from_config", weak)
    with pytest.raises(AssertionError):
        assert judge_heights("threshold", LASERS["threshold"], 0)


FIELDS = ("max_power_w", "period_s", "max_periods", "is_fine")


def sample_hard_sequence(seed):
    """Return trains that several caps trim."""
    random = np.random.default_rng(seed)
    shapes = [(0.04, 0.002), (0.05, 0.01), (0.02, 0.0305)]
    trains = []
    for number in range(6):
        width_s, gap_s = shapes[random.integers(3)]
        trains.append(PulseTrain(int(random.integers(16)), 1.0 * number, 0.9, width_s, gap_s, FULL_W))
    return FrameSequence(trains=tuple(trains))


@pytest.mark.parametrize("seed", [0, pytest.param(range(1, 20), marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["late_and_drooping", "microseconds", "on_off"])
def test_no_cap_is_exceeded_by_the_light_of_the_true_laser(name, seed):
    true_display = build_true_display(build_model("display-16"), build_worst_factors("display-16", -1))
    display, limits = build_display(LASERS[name]), CONFIG.limits
    for each in [seed] if isinstance(seed, int) else seed:
        plan = plan_sequence(display, sample_hard_sequence(each), *display.build_cold_state()).plan
        assert plan.trimmed_j.any()
        light = read_light(LASERS[name], play(display, plan))
        assert (light.power_w > 0.0).all()
        energy_j = light.power_w * light.width_s
        assert energy_j.max() <= limits.pulse_energy_max_j * (1 + 1e-9)
        peaks = true_display.peaks(light)
        assert peaks[0] <= limits.absorber_max_c - CONFIG.ambient_c
        assert peaks[list(TOUCHED)].max() <= display.budget.caps.touch_k
        for of, window_s, cap_w in (
            (light.pixel, limits.pixel_mean_window_s, limits.pixel_mean_power_max_w),
            (np.zeros(len(energy_j)), limits.display_mean_window_s, limits.display_mean_power_max_w),
        ):
            for one in np.unique(of):
                mine = of == one
                begin_s, end_s = light.start_s[mine], (light.start_s + light.width_s)[mine]
                for until_s in end_s:
                    inside_s = np.minimum(end_s, until_s) - np.maximum(begin_s, until_s - window_s)
                    mean_w = float(np.clip(inside_s, 0.0, None) @ light.power_w[mine]) / window_s
                    assert mean_w <= cap_w * (1 + 1e-6)
