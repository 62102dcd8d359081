"""Network DACs as processes, in real time: what a killed or stopped host leaves ends dark by the device's clock."""

import random
import signal
import socket
import time

import numpy as np
import pytest

from dac.bench import build_config, build_network_display, build_train, build_verified
from dac.device_process import DeviceProcess, HostProcess, draw_address, serve_ether_dream, serve_idn
from dac.emulated_ether_dream import EtherDreamCore
from dac.judge import find_rows, read_light
from dac.sample_log import dark_from_s
from optodrive.core.clock import MonotonicClock
from optodrive.link.dac.devices.ether_dream import EtherDream
from optodrive.link.dac.devices.idn import Idn
from optodrive.link.dac.encoding import PointScale
from optodrive.link.dac.formats.ether_dream import EtherDreamFormat
from optodrive.link.dac.formats.idn import IdnFormat
from optodrive.link.dac.player import play

DEVICES = {
    "ether_dream": (serve_ether_dream, EtherDream, EtherDreamFormat.host_loss_max_s),
    "idn": (serve_idn, Idn, IdnFormat.host_loss_max_s),
}
MOMENTS = range(100)


@pytest.fixture(scope="module")
def long_plays():
    """Display, plan and proof of a play of a second on each device."""
    train = build_train(width_s=0.04, gap_s=0.004, duration_s=0.9)
    displays = {transport: build_network_display(transport) for transport in DEVICES}
    return {transport: (display, *build_verified(display, train)) for transport, display in displays.items()}


def start_host(transport, address, verified):
    board, clock = build_config(transport=transport, port=address).board, MonotonicClock()

    def call():
        with DEVICES[transport][1](board, clock) as dac:
            play(dac, verified, clock)

    return HostProcess(call)


def judge_log(log, display, plan, bound_s):
    """Judge what was emitted: pulses of the plan only, and dark within the bound after the last data. Return when."""
    find_rows(read_light(log["table"], display, PointScale.from_config(display.config).point_s), plan)
    assert log["table"][-1, 5] == 0.0
    last_s = log["arrivals_s"].max(initial=0.0)  # none, if the host was stopped before it connected
    assert dark_from_s(log["table"]) <= last_s + bound_s
    return dark_from_s(log["table"])


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("transport", DEVICES)
def test_a_host_that_is_killed_or_stopped(tmp_path, long_plays, transport, number):
    (serve, _, bound_s), (display, plan, verified), emitted = DEVICES[transport], long_plays[transport], 0
    for seed in MOMENTS:
        device = DeviceProcess(serve, tmp_path)
        host = start_host(transport, device.address, verified)
        time.sleep(0.05 + random.Random(seed).uniform(0.0, 0.9))
        host.kill(number)
        if number == signal.SIGSTOP:
            time.sleep(0.3)
            host.kill(signal.SIGKILL)
        host.wait()
        emitted += judge_log(device.finish(), display, plan, bound_s) > 0.0
    assert emitted


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_false_device_that_states_the_name_of_the_genuine_one_gets_no_connection(tmp_path, long_plays):
    (serve, _, bound_s), (display, plan, verified) = DEVICES["ether_dream"], long_plays["ether_dream"]
    with (
        socket.create_server((draw_address(), 7765)) as false,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio,
    ):
        false.setblocking(False)
        radio.bind((false.getsockname()[0], 0))
        for seed in MOMENTS:
            device = DeviceProcess(serve, tmp_path)
            host = start_host("ether_dream", device.address, verified)
            time.sleep(random.Random(seed).uniform(0.0, 0.9))
            for _ in range(3):
                radio.sendto(EtherDreamCore().broadcast(), ("127.0.0.1", 7654))
            said = host.wait()
            judge_log(device.finish(), display, plan, bound_s)
            assert said == "" or "ran out of points" in said  # the second on a computer that is too busy
        with pytest.raises(BlockingIOError):
            false.accept()


def test_a_chunk_that_ends_lit_is_seen_by_this_judge(tmp_path, long_plays):
    """Mutant: all points are lit. The log shows light outside the plan."""
    (serve, _, bound_s), (display, plan, verified) = DEVICES["ether_dream"], long_plays["ether_dream"]
    device = DeviceProcess(serve, tmp_path)
    board, clock = build_config(transport="ether_dream", port=device.address).board, MonotonicClock()
    with EtherDream(board, clock) as dac:
        dac.start()
        table = np.frombuffer(verified.chunks[0].data[3:], dtype="<u2").reshape(-1, 9).copy()
        table[:, 3:7] = 0xFFF0
        dac._command(b"d", verified.chunks[0].data[1:3] + table.tobytes())
        dac._command(b"b", b"\0\0" + (40_000).to_bytes(4, "little"))
        time.sleep(0.1)
    log = device.finish()
    with pytest.raises(AssertionError, match=r"light after a pulse|light before the plan"):
        judge_log(log, display, plan, bound_s)
