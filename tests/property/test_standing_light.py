"""A standing page gets the light of the same frame repeated as a plan, by the board's log."""

from itertools import product

import numpy as np
import pytest

from optodrive.core.types.fingers import FingerPlace
from optodrive.daemon.engine import page_refresh
from optodrive.link.session import staged_job
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli import standing_page
from standing_rig import StandingRig, build_display, build_page, compute_plan_light_j

DURATION_S = 4.0
SHARE_MIN = 0.8
CAPS = {
    "shipped": {},
    "display_0.2_w": {"display_mean_power_max_w": 0.2},
    "display_0.5_w": {"display_mean_power_max_w": 0.5},
    "pixel_0.2_w": {"pixel_mean_power_max_w": 0.2},
    "touch_43_c": {"touch_max_c": 43.0},
}
REPORTED_CAPS = {
    "pixel_0.2_w": {"pixel_mean_power", "galvo_acceleration"},
    "touch_43_c": {"touch_temperature", "galvo_acceleration"},
}
DISPLAYS = {name: build_display(**caps) for name, caps in CAPS.items()}
SHIPPED = DISPLAYS["shipped"]
SEND_PERIODS_S = (np.inf, 1.0, 0.3, 0.1, 0.05)
FINGERS = (0, 1, 2)
FOUND = [
    ("shipped", 6, 500.0, np.inf, 0),
    ("shipped", 12, 350.0, np.inf, 0),
    ("shipped", 3, 450.0, 0.1, 0),
    ("shipped", 12, 20.0, 0.05, 0),
    ("shipped", 1, 500.0, 0.05, 0),
    ("shipped", 1, 20.0, 0.3, 1),
    ("shipped", 12, 250.0, 0.3, 1),
    ("display_0.2_w", 40, 150.0, 0.1, 0),
    ("display_0.2_w", 1, 350.0, np.inf, 0),
    ("shipped", 6, 20.0, 1.0, 1),
    ("shipped", 6, 500.0, 0.3, 1),
    ("shipped", 400, 20.0, 0.1, 1),
]
ALL = list(product(CAPS, (1, 3, 6, 12, 40, 400), (20.0, 50.0, 150.0, 350.0, 500.0), SEND_PERIODS_S, FINGERS))


def begin(monkeypatch, display):
    rig = StandingRig(monkeypatch, display).ready()
    rig.arm()
    rig.run(0.02)
    return rig


def choose_pixels(count):
    return np.random.default_rng(count).choice(len(SHIPPED.layout), count, replace=False)


def place_fingers(display, pixels, count):
    """Return places of fingers, each on a pixel alone."""
    layout = display.layout
    return [
        FingerPlace(k, float(layout.x_m[pixel]), float(layout.y_m[pixel]), 1e-3)
        for k, pixel in enumerate(pixels[:count])
    ]


def stand(monkeypatch, caps, count, height_um, send_period_s, fingers):
    """Let a page stand. Return its light as a share of that of the plan, and the rig."""
    display = DISPLAYS[caps]
    rig, pixels = begin(monkeypatch, display), choose_pixels(count)
    page_m, since_s = build_page(display, pixels, height_um), rig.clock.now_s()
    rig.stand(page_m, DURATION_S, send_period_s, place_fingers(display, pixels, fingers))
    return rig.compute_light_j(since_s) / compute_plan_light_j(display, page_m, DURATION_S), rig


def check(monkeypatch, caps, count, height_um, send_period_s, fingers):
    """Check one page. Dots under fingers, at 25 Hz, may need more than a cap has: their client is told which."""
    share, rig = stand(monkeypatch, caps, count, height_um, send_period_s, fingers)
    assert share >= SHARE_MIN or (fingers and rig.limited_by & REPORTED_CAPS.get(caps, set()))
    assert not rig.refusals
    assert not rig.list_events("fault")
    assert rig.core.state in ("RUNNING", "ARMED")


@pytest.mark.parametrize("case", FOUND)
def test_a_standing_page_gets_the_light_of_its_frame_as_a_plan(monkeypatch, case):
    check(monkeypatch, *case)


@pytest.mark.slow
@pytest.mark.parametrize("case", ALL[::7])
def test_every_standing_page_gets_the_light_of_its_frame_as_a_plan(monkeypatch, case):
    check(monkeypatch, *case)


@pytest.mark.parametrize("case", FOUND[:2])
def test_a_page_that_waits_for_six_pulses_before_its_horizon_is_caught(monkeypatch, case):
    """Mutant: a part of a page is drawn from six pixels on, of any width."""

    def select_enough(*arguments):
        return [burst for burst in standing_page.select_bursts(*arguments) if len(burst.pixels) >= min(case[1], 6)]

    monkeypatch.setattr(page_refresh, "select_bursts", select_enough)
    with pytest.raises(AssertionError):
        check(monkeypatch, *case)


def test_a_page_of_short_pulses_after_one_of_long_ones_is_drawn_at_its_rate(monkeypatch):
    rig, pixels = begin(monkeypatch, SHIPPED), choose_pixels(400)
    rig.stand(build_page(SHIPPED, pixels[:3], 500.0), 0.5)
    rig.stand(build_page(SHIPPED, pixels, 20.0), 0.5)
    since_s = rig.clock.now_s()
    rig.stand(build_page(SHIPPED, pixels, 20.0), 1.0)
    assert len(rig.list_pulses(since_s)) > 400


def test_delays_that_are_no_delays_end_the_link(monkeypatch):
    """Mutant: a point without light counts as begun at its end."""
    monkeypatch.setattr(staged_job, "find_begin_tick", lambda on_tick, *_: on_tick)
    with pytest.raises((AssertionError, ValueError)):
        check(monkeypatch, "display_0.2_w", 40, 150.0, 0.1, 0)


def test_gates_in_microseconds_reach_the_board(monkeypatch):
    config = SHIPPED.config
    laser = config.laser.model_copy(update={"whole_periods": False})
    display = DisplayModel.from_config(config.model_copy(update={"laser": laser}))
    rig = begin(monkeypatch, display)
    page_m, since_s = build_page(display, choose_pixels(40), 50.0), rig.clock.now_s()
    rig.stand(page_m, 1.0)
    assert rig.compute_light_j(since_s) >= SHARE_MIN * compute_plan_light_j(display, page_m, 1.0)
    assert not rig.list_events("fault")
    on_us, off_us, duty = rig.list_pulses(since_s).T
    is_whole = (off_us - on_us) % 200 == 0
    assert np.mean(is_whole) < 0.5
    assert (duty[~is_whole] == 65535).all()
