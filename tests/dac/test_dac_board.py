"""The board of a laser DAC in virtual time: what the device emits, and that STOP, lease and death end it."""

import random
from contextlib import suppress

import numpy as np
import pytest

from dac import emulated_ether_dream, emulated_helios, emulated_idn
from dac.bench import build_frame, build_train
from dac.dac_host import TRANSPORTS, DacHost
from dac.judge import judge_caps, judge_place
from dac.sample_log import dark_from_s
from optodrive.device.config_sections import IDN_STRETCH
from optodrive.link.dac.formats.registry import FORMATS
from optodrive.link.simulator.dac_board import DacBoard, OutputSampler, build_levels
from reference_models.shipped_display import build_model, build_worst_factors
from reference_models.thermal_display import build_true_display

LONG = build_train(width_s=0.04, gap_s=0.004, duration_s=1.0)
DEAD = (emulated_ether_dream.HostDeadError, emulated_helios.HostDeadError, emulated_idn.HostDeadError)
COMMAND_S = 0.005
"""Longest time from a frame of the host to the device's stop: a step of the bench and a transfer under way."""
LEASE_S = 0.1
REST_S = {"ether_dream": 0.0, "helios": 0.0, "idn": FORMATS["idn"].host_loss_max_s}
"""Light after a stop: an IDN device plays what it has, also after its stop."""


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("kind", ["train", "frame"])
def test_the_light_is_the_plan_and_never_more(transport, kind):
    """All but a hundredth of what is left of the pulses without the points at their ends."""
    host = DacHost(transport)
    host.arm()
    plan = host.plan(build_train(power_w=1.5) if kind == "train" else build_frame(host.display, 50e-6, 0.5))
    executed, light = host.play(plan), host.light()
    dac_format = FORMATS[transport](40_000)
    whole_s = plan.width_s - (2 + dac_format.settling_points) * dac_format.slowest_point_s
    # An IDN device emits all at its slowest, while its buffer fills, and later 1/1.3.
    min_j = 0.99 * plan.power_w @ whole_s / (IDN_STRETCH if transport == "idn" else 1.0)
    assert min_j <= light.power_w @ light.width_s <= plan.energy_j.sum()
    per_pixel_j = np.bincount(light.pixel, light.power_w * light.width_s, minlength=16)
    assert (per_pixel_j <= np.bincount(plan.pixel, plan.energy_j, minlength=16) + 1e-12).all()
    assert judge_place(light, host.display) <= 0.0
    judge_caps(
        light, host.display, build_true_display(build_model("display-16"), build_worst_factors("display-16", -1))
    )
    assert executed.complete
    assert host.boards.state == "ARMED"


def test_a_slower_ether_dream_gets_as_much_light():
    host = DacHost("ether_dream", extra_ticks=1)
    host.arm()
    plan = host.plan(build_train(power_w=1.5, duration_s=1.0))
    host.play(plan)
    light = host.light()
    assert 0.99 <= light.power_w @ light.width_s / plan.energy_j.sum() <= 1.0


def begin_long(transport, board=DacBoard, after_s=0.5):
    host = DacHost(transport, board)
    host.arm()
    host.begin(host.plan(LONG))
    host.step(after_s)
    return host


def stop(host):
    """Press STOP, and return how long light goes on by the device's clock."""
    stopped_s = host.clock.now_s()
    assert dark_from_s(host.table()) >= stopped_s - 0.05, "no light before the stop"
    host.boards.abort()
    host.step(0.3)
    return dark_from_s(host.table()) - stopped_s


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_stop_is_dark_at_once(transport):
    assert stop(begin_long(transport)) <= COMMAND_S + REST_S[transport]


class WithoutStop(DacBoard):
    """Mutant: a board that is disarmed lets the DAC play on."""

    def _drive(self, now_us):
        if self.state != "DISARMED":
            super()._drive(now_us)


def test_a_board_without_stop_is_caught():
    assert stop(begin_long("ether_dream", WithoutStop)) > 2 * COMMAND_S


def lose_lease(host):
    """Renew no lease, and return how long light goes on."""
    host.step(0.03)
    silent_s = host.clock.now_s()
    host.step(0.4, renew_lease=False)
    return dark_from_s(host.table()) - silent_s


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_an_expired_lease_is_dark(transport):
    host = begin_long(transport, after_s=0.3)
    assert lose_lease(host) <= LEASE_S + COMMAND_S + REST_S[transport]
    assert host.board.fault == "LINK"


class WithoutLease(DacBoard):
    """Mutant: the lease never ends."""

    def advance(self, now_us):
        self.machine.renew_lease(1000)
        super().advance(now_us)


def test_a_board_without_lease_is_caught():
    assert lose_lease(begin_long("ether_dream", WithoutLease, after_s=0.3)) > LEASE_S + COMMAND_S


def check_death(transport, seed):
    """Kill the process of the board at a random moment of a plan. Return for how long the device emits."""
    host = DacHost(transport)
    host.arm()
    host.begin(host.plan(LONG))
    host.device.dies_at_s = host.clock.now_s() + random.Random(seed).uniform(0.0, 1.1)
    with suppress(*DEAD):
        host.step(1.2)
    host.pass_time(0.3)
    table = host.table()
    assert table[-1, 5] == 0.0
    rest_s = dark_from_s(table) - host.device.dies_at_s
    assert rest_s <= FORMATS[transport].host_loss_max_s
    return rest_s


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_killed_board_is_dark_within_the_devices_bound(transport):
    for seed in range(2):
        check_death(transport, seed)


@pytest.mark.slow
@pytest.mark.timeout(0)
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_board_that_is_killed_at_fifty_moments(transport):
    assert max(check_death(transport, seed) for seed in range(100, 150)) > 0.0


@pytest.mark.parametrize("stall_s", [0.06, 0.3])
def test_a_stall_of_this_computer_in_a_plan_is_a_fault(stall_s):
    """The DAC ran empty: light of the plan is lost, and its mirrors are elsewhere."""
    host = begin_long("ether_dream", after_s=0.3)
    host.clock.sleep(stall_s)
    host.step(0.2)
    assert host.board.fault in ("UNDERRUN", "LINK")
    assert dark_from_s(host.table()) <= host.clock.now_s() - 0.2


def test_a_stall_without_a_plan_ends_in_nothing():
    host = DacHost("ether_dream")
    host.arm()
    host.clock.sleep(0.06)
    host.step(0.2)
    plan = host.plan(build_train(power_w=1.0))
    assert host.play(plan).complete
    assert host.boards.state == "ARMED"


def test_points_are_lit_only_if_the_gate_is_on_all_their_time():
    dac_format = FORMATS["ether_dream"](40_000)
    sampler = OutputSampler(dac_format, build_levels(dac_format))
    period_us = sampler.period_us
    sampler.restart(0.0)
    sampler.move_to(65535, 1, 10)
    sampler.light(65535, round(10.4 * period_us))
    sampler.light(0, round(20.6 * period_us))
    sampler.move_to(32768, 32768, round(20.6 * period_us))
    points = sampler.take(30)
    assert np.flatnonzero(points[:, 2]).tolist() == list(range(11, 20))
    assert set(points[11:20, 2]) == {4088}  # one tick of 601 less
    assert points[0, :2].tolist() == [4095, 1]
    assert points[19, :2].tolist() == [4095, 1]
    assert points[20, :2].tolist() == [2048, 2048], "the mirrors leave with the light"


def test_a_chunk_ends_dark_within_a_pulse():
    dac_format = FORMATS["ether_dream"](40_000)
    sampler = OutputSampler(dac_format, build_levels(dac_format))
    sampler.restart(0.0)
    sampler.light(65535, 0)
    assert sampler.take(10)[:, 2].tolist() == [4088] * 9 + [0]
    assert sampler.take(10)[:, 2].tolist() == [4088] * 9 + [0]
