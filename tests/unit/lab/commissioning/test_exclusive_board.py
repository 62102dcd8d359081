"""Exclusive board access in virtual time: permitted points, and the end of access."""

import numpy as np
import pytest

from exclusive_rig import ExclusiveRig, limited
from optodrive.core.errors import BoardFaultError, InputError, NotReadyError, RefusedError
from optodrive.lab.commissioning.exclusive_board import (
    find_weakest_pixel,
    max_settling_s,
    max_spot_power_w,
    spot_width_s,
)
from optodrive.link.protocol.quantisation import DUTY_MAX
from optodrive.link.simulator.galvos import CENTRE_CODE, SimulatedGalvos

CENTRE = (CENTRE_CODE, CENTRE_CODE)


class Rig(ExclusiveRig):
    def __init__(self, display):
        self.mirrors = SimulatedGalvos(display.config, 0)
        super().__init__(display, self.mirrors.move_to)


@pytest.fixture
def rig(display):
    return Rig(display)


def test_a_spot_is_one_pulse_with_mirrors_at_rest(rig):
    with rig.armed() as held:
        codes = CENTRE_CODE + 15_000, CENTRE_CODE - 15_000
        held.fire_spot(*codes, 5e-3)
        (pulse,) = rig.of("pulse")
        assert (pulse["x"], pulse["y"]) == codes
        assert pulse["off_us"] - pulse["on_us"] == round(1e6 * spot_width_s(held.config)) == 20_000
        assert pulse["duty"] / DUTY_MAX * held.config.laser.max_power_w == pytest.approx(5e-3, rel=0.01)
        assert rig.mirrors.codes(pulse["on_us"]) == pytest.approx(codes, abs=0.1)
    assert rig.core.state == "DISARMED"


def test_a_move_keeps_the_gate_off(rig):
    with rig.armed() as held:
        for sign in (1, -1, 1):
            held.move_to(CENTRE_CODE + sign * 15_000, CENTRE_CODE)
            assert rig.mirrors.codes(held_us(rig))[0] == pytest.approx(CENTRE_CODE + sign * 15_000, abs=0.1)
    assert not rig.of("pulse")
    assert not rig.of("gate")


def held_us(rig):
    return round(1e6 * rig.clock.now_s())


@pytest.mark.parametrize("power_w", [0.0, -1e-3, 0.0501, 2.45, float("nan")])
def test_no_spot_beyond_its_power(rig, power_w):
    with rig.armed() as held, pytest.raises(InputError, match="at most 50 mW"):
        held.fire_spot(*CENTRE, power_w)
    assert not rig.of("pulse")


@pytest.mark.parametrize("codes", [(CENTRE_CODE + 18_000, CENTRE_CODE), (CENTRE_CODE, 0), (-5, CENTRE_CODE)])
def test_no_spot_far_outside_the_display(rig, codes):
    with rig.armed() as held, pytest.raises(InputError, match="the display and 4 mm more"):
        held.fire_spot(*codes, 5e-3)
    assert not rig.of("fault")
    assert rig.core.state == "DISARMED"


def test_what_the_limiter_refuses_never_reaches_the_board(display):
    """A pulse of 20 ms and 50 mW has 1 mJ, twice the cap."""
    rig = Rig(limited(display, pulse_energy_max_j=0.5e-3))
    with rig.armed() as held, pytest.raises(RefusedError, match="pulse energy cap"):
        held.fire_spot(*CENTRE, 0.05)
    assert not rig.of("pulse")
    assert not rig.of("gate")
    assert rig.core.state == "DISARMED"


def test_spots_anywhere_count_on_one_pixel(display):
    """An uncalibrated beam may hit a neighbour, so a pixel's mean-power cap applies at each position."""
    rig = Rig(limited(display, pixel_mean_power_max_w=5e-3, pixel_mean_window_s=1.0))
    places = [(CENTRE_CODE + 3000 * column, CENTRE_CODE + 3000 * row) for row in (-4, 0, 4) for column in (-4, 0, 4)]
    with rig.armed() as held:
        for place in places:
            held.fire_spot(*place, 0.05)
    pulses = rig.of("pulse")
    assert len(pulses) == len(places)
    energy_j = 0.05 * 0.02
    window = [sum(abs(other["on_us"] - pulse["on_us"]) < 500_000 for other in pulses) for pulse in pulses]
    assert max(window) * energy_j <= 5e-3 * 1.0 + energy_j


def test_spots_at_their_most_hardly_warm_anything(any_display):
    heat, config = any_display.budget.heat, any_display.config
    pixel = find_weakest_pixel(any_display)
    for other in range(len(any_display.pixels)):
        assert heat.epsilon[other] * heat.r_k_per_w[other] <= heat.epsilon[pixel] * heat.r_k_per_w[pixel]
    steady_k = float(heat.epsilon[pixel] * heat.r_k_per_w[pixel]) * max_spot_power_w(config)
    assert steady_k < 0.05 * any_display.budget.caps.absorber_k
    assert max_spot_power_w(config) <= 0.05 * config.laser.max_power_w


def test_widths_and_waits_are_whole_and_long_enough(any_display):
    config = any_display.config
    periods = spot_width_s(config) * config.laser.pwm_hz
    assert periods == pytest.approx(round(periods))
    assert spot_width_s(config) <= config.limits.pulse_width_max_s
    assert max_settling_s(config) * 1e6 >= any_display.scan_head.settling.lead_in_us


@pytest.mark.parametrize(("name", "value"), [("interlock", False), ("key", False), ("estop", True)])
def test_an_unsafe_input_is_named_and_turns_the_gate_off(rig, name, value):
    with rig.armed() as held:
        held.fire_spot(*CENTRE, 5e-3)
        rig.core.set_input(name, value, held_us(rig))
        with pytest.raises(BoardFaultError, match=f"FAULT {name.upper()}"):
            held.wait(1.0)
    assert rig.core.state == "FAULT"
    assert not rig.core.gate


def test_leaving_the_context_disarms(rig):
    def leave():
        with rig.armed():
            assert rig.core.state == "ARMED"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        leave()
    assert rig.core.state == "DISARMED"
    assert rig.of("state")[-1]["reason"] == "abort"


def test_an_unarmed_board_emits_nothing(rig):
    rig.held.connect()
    with rig.held as held, pytest.raises(NotReadyError, match="not armed"):
        held.fire_spot(*CENTRE, 5e-3)
    assert not rig.of("gate")


def test_indicator_takes_two_seconds(rig):
    rig.held.connect()
    with rig.held as held:
        assert held.arm() >= 2.0


def test_late_points_count_as_late(rig):
    """The limiter's timeline follows the board's: many spots do not accumulate, and the galvos cool."""
    with rig.armed() as held:
        for _ in range(30):
            for sign in (1, -1):
                held.fire_spot(CENTRE_CODE + sign * 15_000, CENTRE_CODE + sign * 15_000, 0.05)
    pulses = rig.of("pulse")
    assert len(pulses) == 60
    assert np.all(np.diff([pulse["on_us"] for pulse in pulses]) > 20_000)
