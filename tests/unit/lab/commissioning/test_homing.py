"""First light in virtual time: its place, its weakness and its rate, and the conditions that prevent it."""

from itertools import pairwise

import pytest

from exclusive_rig import ExclusiveRig
from optodrive.cli.main import run
from optodrive.core.errors import BoardFaultError, InputError, RefusedError
from optodrive.lab.commissioning.exclusive_board import max_spot_power_w, spot_width_s
from optodrive.lab.commissioning.homing import default_power_w, emit_first_light
from optodrive.link.protocol.quantisation import CENTRE_CODE, DUTY_MAX
from optodrive.planning.display_model import DisplayModel


class Rig(ExclusiveRig):
    def __init__(self, display):
        super().__init__(display, lambda x_code, y_code, at_us: None)
        self.steps = []

    def emit(self, power_w, pulses=1):
        with self.held as board:
            emit_first_light(board, power_w, pulses, False, lambda step: self.steps.append(step.step))


def test_one_weak_pulse_at_the_centre(any_display):
    rig, config = Rig(any_display), any_display.config
    rig.emit(default_power_w(config))
    (pulse,) = rig.of("pulse")
    assert (pulse["x"], pulse["y"]) == (CENTRE_CODE, CENTRE_CODE)
    assert 0.009 < pulse["duty"] / DUTY_MAX <= 0.01
    assert (pulse["off_us"] - pulse["on_us"]) * 1e-6 == pytest.approx(spot_width_s(config))
    assert [event["on"] for event in rig.of("gate")] == [True, False]
    assert rig.core.state == "DISARMED"
    assert rig.steps == ["link", "status", "inputs", "indicator", "light", "end"]


def test_pulses_are_a_second_apart(display):
    rig = Rig(display)
    rig.emit(5e-3, 3)
    on_us = [pulse["on_us"] for pulse in rig.of("pulse")]
    assert len(on_us) == 3
    assert min(b - a for a, b in pairwise(on_us)) >= 1_000_000


@pytest.mark.parametrize(("name", "value"), [("interlock", False), ("key", False), ("estop", True)])
def test_an_unsafe_input_prevents_it(display, name, value):
    rig = Rig(display)
    rig.core.set_input(name, value, round(rig.clock.now_s() * 1e6))
    with pytest.raises((RefusedError, BoardFaultError), match=name.upper()):
        rig.emit(5e-3)
    assert not rig.of("gate")


@pytest.mark.parametrize(("power_w", "pulses"), [(0.0, 1), (2.45, 1), (float("nan"), 1), (5e-3, 0), (5e-3, 101)])
def test_no_more_than_a_spot(display, power_w, pulses):
    rig = Rig(display)
    with pytest.raises(InputError):
        rig.emit(power_w, pulses)
    assert not rig.of("gate")
    assert rig.core.state == "DISARMED"


def test_the_default_is_never_more_than_a_spot(any_display):
    assert default_power_w(any_display.config) <= max_spot_power_w(any_display.config)


@pytest.mark.parametrize(
    ("laser", "duty", "width_us"),
    [
        ({"threshold_w": 0.245}, 6554, 2000),
        ({"modulation": "on_off"}, DUTY_MAX, 200),
        ({"threshold_w": 0.01}, 655, 20_000),
    ],
)
def test_a_laser_that_emits_nothing_so_weak_gets_a_shorter_pulse(display, laser, duty, width_us):
    table = display.config.model_dump()
    config = type(display.config).model_validate(table | {"laser": table["laser"] | laser})
    rig = Rig(DisplayModel.from_config(config))
    shortest_w = config.min_power_w / config.laser.width_steps_hz / spot_width_s(config)
    with pytest.raises(InputError, match="mW, that of the laser's weakest and shortest pulse"):
        rig.emit(0.99 * shortest_w, 1)
    assert not rig.of("gate")
    rig.emit(default_power_w(config), 1)
    (pulse,) = rig.of("pulse")
    assert pulse["duty"] == pytest.approx(duty, abs=1)
    # No more energy than a spot of a weak laser, and less by at most a PWM period.
    assert -200 <= pulse["off_us"] - pulse["on_us"] - width_us <= 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "--yes: missing, expected --yes, because without a terminal nobody can confirm: this arms the board"),
        (["--power-mw", "51", "--yes"], "--power-mw: got 51 mW, expected more than 0 and at most 50 mW"),
        (["--power-mw", "9999", "--yes"], "--power-mw: got 9999 mW, expected more than 0 and at most 50 mW"),
        (["--pulses", "0", "--yes"], "--pulses: got 0, expected 1 to 100"),
    ],
)
def test_the_command_refuses_before_it_opens_the_board(capsys, arguments, says):
    assert run(["first-light", *arguments]) == 2
    assert says in capsys.readouterr().err
