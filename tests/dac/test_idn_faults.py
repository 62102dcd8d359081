"""Faults of host and network while an IDN device plays, in real time: each ends dark, by the device's own clock."""

import random
import signal
import socket
import struct
import time

import pytest

from dac.bench import build_config, build_network_display, build_train, build_verified
from dac.device_process import DeviceProcess, HostProcess, draw_address, serve_idn
from dac.judge import find_rows, read_light
from dac.network_faults import UdpProxy
from dac.sample_log import dark_from_s
from optodrive.core.clock import MonotonicClock
from optodrive.link.dac.devices.idn import Idn
from optodrive.link.dac.encoding import PointScale
from optodrive.link.dac.formats.idn import IdnFormat
from optodrive.link.dac.player import play

BOUND_S = IdnFormat.host_loss_max_s
MOMENTS = [range(3), pytest.param(range(3, 100), marks=[pytest.mark.slow, pytest.mark.timeout(1200)])]
IDS = ["some", "all"]
FAULTS = {
    "loss": {"lost": 0.01},
    "duplicates": {"repeated": 0.3},
    "reordering": {"delayed": 0.1, "delay_s": 0.02},
    "all": {"lost": 0.003, "repeated": 0.1, "delayed": 0.1},
}


@pytest.fixture(scope="module")
def long_play():
    display = build_network_display("idn")
    return display, *build_verified(display, build_train(width_s=0.04, gap_s=0.004, duration_s=0.9))


def start_host(address, long_play):
    _, _, verified = long_play
    board, clock = build_config(transport="idn", port=address).board, MonotonicClock()

    def call():
        with Idn(board, clock) as dac:
            play(dac, verified, clock)

    return HostProcess(call)


def judge_log(log, long_play):
    """Judge what was emitted: pulses of the plan only, and dark within the bound after the last data. Return when."""
    display, plan, _ = long_play
    find_rows(read_light(log["table"], display, PointScale.from_config(display.config).point_s), plan)
    assert log["table"][-1, 5] == 0.0
    last_s = log["arrivals_s"].max(initial=0.0)
    assert dark_from_s(log["table"]) <= last_s + BOUND_S
    return dark_from_s(log["table"])


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("seeds", MOMENTS, ids=IDS)
def test_a_host_that_is_killed_or_stopped(tmp_path, long_play, seeds, number):
    emitted = 0
    for seed in seeds:
        device = DeviceProcess(serve_idn, tmp_path)
        host = start_host(device.address, long_play)
        time.sleep(0.05 + random.Random(seed).uniform(0.0, 0.9))
        host.kill(number)
        if number == signal.SIGSTOP:
            time.sleep(0.3)
            host.kill(signal.SIGKILL)
        host.wait()
        emitted += judge_log(device.finish(), long_play) > 0.0
    assert emitted


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seeds", MOMENTS, ids=IDS)
def test_a_network_that_fails(tmp_path, long_play, seeds, fault):
    emitted, counts = 0, 0
    for seed in seeds:
        device = DeviceProcess(serve_idn, tmp_path)
        proxy = UdpProxy(draw_address(), (device.address, 7255), seed, **FAULTS[fault])
        said = start_host(proxy.address, long_play).wait()
        proxy.close()
        emitted += judge_log(device.finish(), long_play) > 0.0
        counts += sum(proxy.counts.values())
        assert said == "" or (said.startswith("LinkError: ") and "IDN device" in said and "\n" not in said)
    assert emitted
    assert counts


@pytest.mark.parametrize("seeds", MOMENTS, ids=IDS)
def test_a_second_client_that_commands(tmp_path, long_play, seeds):
    """Only the plan is emitted, and the end is dark, also after samples, ends of connections, and nonsense."""
    emitted = 0
    for seed in seeds:
        rng = random.Random(seed)
        device = DeviceProcess(serve_idn, tmp_path)
        host = start_host(device.address, long_play)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
            time.sleep(rng.uniform(0.05, 0.95))
            for _ in range(rng.randint(1, 20)):
                command = rng.choice([0x40, 0x41, 0x44, 0x45, 0x10, 0x12, rng.randrange(256)])
                body = rng.choice([b"", rng.choice(long_play[2].chunks).data, rng.randbytes(30)])
                second.sendto(struct.pack(">BBH", command, 0, rng.randrange(65_536)) + body, (device.address, 7255))
        said = host.wait()
        emitted += judge_log(device.finish(), long_play) > 0.0
        assert said == "" or (said.startswith("LinkError: ") and "IDN device" in said and "\n" not in said)
    assert emitted
