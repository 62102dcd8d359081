"""Dimming in virtual time, judged from the power of the pulses in the board's log."""

import pytest

from link_service_rig import REQUIREMENTS
from optodrive.core.errors import InputError, OverBudgetError
from optodrive.daemon.engine.active_plan import ThermalEstimate
from optodrive.daemon.engine.plan_making import Dimmer, DryRunStart
from optodrive.daemon.engine.plan_rest import ThermalMemory
from optodrive.daemon.preview.jobs import plan_dry_run
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.planning.display_model import DisplayModel
from planner_rig import DISPLAY, build_frame, build_train

DUTY_MAX = 65535


def play(rig, sequence):
    """Play a sequence. Return its plan and the largest share of full power that the board has emitted for it."""
    before = len(rig.list_emitted())
    plan = rig.submit(sequence, rig.remote.epoch).result()
    record = rig.store.find(plan.plan)
    rig.until(lambda: record.has_ended)
    return plan, max((duty for _, duty in rig.list_emitted()[before:]), default=0) / DUTY_MAX


def test_plans_have_at_most_the_share_and_say_why(rig):
    plan, bright = play(rig, build_frame(90.0))
    assert plan.summary.trimmed.pulses == 0
    share = bright / 2
    rig.dimmer.set_share(share)
    plan, dimmed = play(rig, build_frame(90.0))
    assert 0.99 * share < dimmed <= share
    assert set(plan.pulses.reason) == {"dim"}
    rig.dimmer.set_share(1.0)
    assert play(rig, build_frame(90.0))[1] > share
    rig.dimmer.set_share(0.0)
    plan, dark = play(rig, build_train(0.1))
    assert (dark, plan.status) == (0, "queued")


def test_a_laser_that_is_on_or_off_is_not_dimmed():
    table = DISPLAY.config.model_dump()
    config = type(DISPLAY.config).model_validate(table | {"laser": table["laser"] | {"modulation": "on_off"}})
    dimmer = Dimmer(DisplayModel.from_config(config), ThermalMemory())
    with pytest.raises(InputError, match=r"share: got 0\.5, expected 0 or 1: with laser\.modulation 'on_off'"):
        dimmer.set_share(0.5)
    dimmer.set_share(0.0)
    assert dimmer.power_share == 0.0


def test_a_plan_that_is_being_made_while_the_display_is_dimmed_is_made_again(rig):
    def dim():
        rig.before_loop_action = lambda: None
        rig.dimmer.set_share(0.1)

    rig.before_loop_action = dim
    plan, dimmed = play(rig, build_frame(90.0))
    assert 0.0 < dimmed <= 0.1
    assert set(plan.pulses.reason) == {"dim"}


def test_without_the_comparison_at_the_commit_it_would_be_bright(rig, monkeypatch):
    """Mutant: the queue's commit alone decides."""
    shown = rig.dimmer.display
    constant = property(lambda dimmer: shown, lambda dimmer, display: None)
    monkeypatch.setattr(Dimmer, "display", constant, raising=False)

    def dim():
        rig.before_loop_action = lambda: None
        rig.dimmer.set_share(0.1)

    rig.before_loop_action = dim
    assert play(rig, build_frame(90.0))[1] > 0.1


def test_under_refuse_a_dimmed_pulse_is_refused(rig):
    rig.dimmer.set_share(0.1)
    with pytest.raises(OverBudgetError, match="the dim cap allows") as caught:
        rig.submit(build_frame(), rig.remote.epoch, options={"policy": "refuse"}).result()
    assert caught.value.cap == "dim"


def test_a_later_planner_is_as_dim():
    memory = ThermalMemory()
    dimmer = Dimmer(DISPLAY, memory)
    assert dimmer.power_share == 1.0
    assert dimmer.display is DISPLAY
    dimmer.set_share(0.3)
    assert Dimmer(DISPLAY, memory).power_share == 0.3
    assert Dimmer(dimmer.display, ThermalMemory()).power_share == 0.3  # as configured
    with pytest.raises(InputError, match=r"a number from 0 to 0\.3"):
        Dimmer(dimmer.display, ThermalMemory()).set_share(0.4)
    for share in (-0.1, 1.1, float("nan")):
        with pytest.raises(InputError, match="a number from 0 to 1"):
            dimmer.set_share(share)
    assert dimmer.power_share == 0.3


def test_a_dry_run_is_as_dim():
    start = DryRunStart(ThermalEstimate(*DISPLAY.build_cold_state()), 0.0, power_share=0.1)
    built, push = BuiltRequest(build_frame(90.0)), Push("dry", {}, 0.0, 0)
    report = plan_dry_run(DISPLAY, [REQUIREMENTS.scale], built, start, push)
    assert set(report.pulses.reason) == {"dim"}
    assert max(report.pulses.power_w) <= 0.1 * DISPLAY.config.laser.max_power_w
