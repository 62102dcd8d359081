"""Faults of host and network while an Ether Dream plays, in real time: each ends dark, by the device's own clock."""

import random
import signal
import socket
import time
from contextlib import suppress

import numpy as np
import pytest

from dac.bench import build_config, build_network_display, build_train, build_verified
from dac.device_process import DeviceProcess, HostProcess, draw_address, serve_ether_dream
from dac.emulated_ether_dream import EtherDreamCore
from dac.judge import find_rows, read_light
from dac.network_faults import TcpProxy
from dac.sample_log import dark_from_s
from optodrive.core.clock import MonotonicClock
from optodrive.link.dac.devices.ether_dream import EtherDream
from optodrive.link.dac.encoding import PointScale
from optodrive.link.dac.formats.ether_dream import EtherDreamFormat
from optodrive.link.dac.player import play

BOUND_S = EtherDreamFormat.host_loss_max_s
MOMENTS = [range(3), pytest.param(range(3, 100), marks=[pytest.mark.slow, pytest.mark.timeout(1200)])]
IDS = ["some", "all"]
COMMANDS = [b"s", b"\xff", b"\0", b"c", b"p", b"?", b"b\0\0\x40\x9c\0\0", b"q\x10\x27\0\0", b"Z"]
"""Of a second client: stop, emergency stop twice, its clearance, prepare, ask, begin, another rate, nonsense."""


@pytest.fixture(scope="module")
def long_play():
    display = build_network_display("ether_dream")
    return display, *build_verified(display, build_train(width_s=0.04, gap_s=0.004, duration_s=0.9))


def start_host(address, long_play):
    _, _, verified = long_play
    board = build_config(transport="ether_dream", port=address).board
    clock = MonotonicClock()

    def call():
        with EtherDream(board, clock) as dac:
            play(dac, verified, clock)

    return HostProcess(call)


def judge_log(log, long_play):
    """Judge what was emitted: pulses of the plan only, and dark within the bound after the last data. Return when."""
    display, plan, _ = long_play
    find_rows(read_light(log["table"], display, PointScale.from_config(display.config).point_s), plan)
    assert log["table"][-1, 5] == 0.0
    last_s = log["arrivals_s"].max(initial=0.0)  # none, if the host was stopped before it connected
    assert dark_from_s(log["table"]) <= last_s + BOUND_S
    return dark_from_s(log["table"])


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("seeds", MOMENTS, ids=IDS)
def test_a_host_that_is_killed_or_stopped(tmp_path, long_play, seeds, number):
    emitted = 0
    for seed in seeds:
        device = DeviceProcess(serve_ether_dream, tmp_path)
        host = start_host(device.address, long_play)
        time.sleep(0.05 + random.Random(seed).uniform(0.0, 0.9))
        host.kill(number)
        if number == signal.SIGSTOP:
            time.sleep(0.3)
            host.kill(signal.SIGKILL)
        host.wait()
        emitted += judge_log(device.finish(), long_play) > 0.0
    assert emitted


@pytest.mark.parametrize("fault", ["stall", "half-open", "reset"])
@pytest.mark.parametrize("seeds", MOMENTS, ids=IDS)
def test_a_network_that_fails(tmp_path, long_play, seeds, fault):
    emitted = 0
    for seed in seeds:
        device = DeviceProcess(serve_ether_dream, tmp_path)
        after = random.Random(seed).randint(20_000, 500_000)
        proxy = TcpProxy(draw_address(), (device.address, 7765), after, fault, stall_s=0.3)
        host = start_host(proxy.address, long_play)
        said = host.wait()
        proxy.close()
        log = device.finish()
        emitted += judge_log(log, long_play) > 0.0
        assert "Ether Dream" in said
        assert said.startswith("LinkError: ")
        assert "\n" not in said
    assert emitted


def test_a_second_client_that_only_looks_changes_nothing_of_what_is_emitted(tmp_path, long_play):
    device = DeviceProcess(serve_ether_dream, tmp_path)
    host = start_host(device.address, long_play)
    with socket.create_connection((device.address, 7765)) as second:
        for _ in range(20):
            second.sendall(b"?")
            second.recv(22)
    said = host.wait()
    log = device.finish()
    judge_log(log, long_play)
    assert said == "" or "ran out of points" in said  # the second on a computer that is too busy


@pytest.mark.parametrize("seeds", MOMENTS, ids=IDS)
def test_a_second_client_that_commands(tmp_path, long_play, seeds):
    """Only the plan is emitted, and the end is dark, also after an emergency stop, its clearance, and nonsense."""
    emitted = 0
    for seed in seeds:
        rng = random.Random(seed)
        device = DeviceProcess(serve_ether_dream, tmp_path)
        host = start_host(device.address, long_play)
        with socket.create_connection((device.address, 7765)) as second:
            time.sleep(rng.uniform(0.05, 0.95))
            with suppress(OSError):  # the device closes the connection of one who sends nonsense
                for _ in range(rng.randint(1, 4)):
                    second.sendall(rng.choice(COMMANDS))
        said = host.wait()
        emitted += judge_log(device.finish(), long_play) > 0.0
        assert said == "" or (said.startswith("LinkError: ") and "Ether Dream" in said and "\n" not in said)
    assert emitted


@pytest.mark.parametrize("seeds", MOMENTS, ids=IDS)
def test_a_false_device_that_states_the_name_of_the_genuine_one_gets_no_connection(tmp_path, long_play, seeds):
    with (
        socket.create_server((draw_address(), 7765)) as false,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio,
    ):
        false.setblocking(False)
        radio.bind((false.getsockname()[0], 0))
        for seed in seeds:
            device = DeviceProcess(serve_ether_dream, tmp_path)
            host = start_host(device.address, long_play)
            time.sleep(random.Random(seed).uniform(0.0, 0.9))
            for _ in range(3):
                radio.sendto(EtherDreamCore().broadcast(), ("127.0.0.1", 7654))
            said = host.wait()
            judge_log(device.finish(), long_play)
            assert said == "" or "ran out of points" in said  # the second on a computer that is too busy
        with pytest.raises(BlockingIOError):
            false.accept()


def test_a_chunk_that_ends_lit_is_seen_by_this_judge(tmp_path, long_play):
    """Mutant: all points are lit. The log shows light outside the plan."""
    device = DeviceProcess(serve_ether_dream, tmp_path)
    verified = long_play[2]
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
        judge_log(log, long_play)
