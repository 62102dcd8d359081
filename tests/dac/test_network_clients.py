"""Emulated network DACs as processes: clients that were written elsewhere, and discovery."""

import os
import socket
import time

import numpy as np
import pytest
from ether_dream import ether_dream as foreign

from dac.device_process import DeviceProcess, serve_ether_dream, serve_idn
from optodrive.core.clock import MonotonicClock
from optodrive.link.dac.discovery import find_ether_dreams, find_idn_devices


def free_udp_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
        radio.bind(("", 0))
        return radio.getsockname()[1]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # it leaves its broadcast socket open
def test_the_client_of_pypi_finds_it_and_plays_every_point(tmp_path, monkeypatch):
    port = free_udp_port()
    device = DeviceProcess(serve_ether_dream, tmp_path, port)
    monkeypatch.setattr(foreign, "BROADCAST_PORT", port)
    dac = foreign.get_dac()
    assert dac.conn.getpeername() == (device.address, 7765)
    assert dac.firmware_string == "(old)"
    points = [(100 * 16, -50 * 16, 0, 0, 16 * (1 + number % 4095)) for number in range(10_472)]
    stream = iter(points)
    dac.prepare()
    sent = begun = 0
    while sent < len(points):
        room = 1799 - dac.last_status.fullness
        batch = [point for _, point in zip(range(room), stream, strict=False)]
        if batch:
            dac.write(batch)
            sent += len(batch)
        if not begun:
            begun = dac.begin(0, 1000)  # slow enough for any computer
            dac.update(0, 20_000) if sent == len(points) else None
        if sent < len(points):
            dac.update(0, 60_000)
        dac.ping()
    while dac.ping().playback_state == foreign.PLAYBACK_STATE_PLAYING:
        pass
    dac.conn.close()
    log = device.finish()
    assert log["played"] == len(points)
    light = log["table"][log["table"][:, 5] > 0]
    levels = np.rint(light[:, 5] * 4095).astype(int)
    assert levels.tolist() == [1 + number % 4095 for number in range(10_472)]
    assert set(light[:, 3]) == {2048 + 100}
    assert set(light[:, 4]) == {2048 - 50}


def test_discovery_lists_a_device_and_survives_what_else_arrives(tmp_path):
    port = free_udp_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as liar:
        liar.bind(("127.0.0.1", 0))
        device = DeviceProcess(serve_ether_dream, tmp_path, port)
        pid = os.fork()
        if not pid:
            while True:
                for data in (b"", b"\x1b[2J" * 9, bytes(36), bytes(2000)):
                    liar.sendto(data, ("127.0.0.1", port))
                    time.sleep(0.01)
        found = find_ether_dreams(MonotonicClock(), udp_port=port)
        os.kill(pid, 9)
        os.waitpid(pid, 0)
    device.finish()
    genuine, false = sorted(found, key=lambda dac: dac.port != device.address)
    assert (genuine.name, genuine.port) == ("00:04:a3:01:02:03", device.address)
    assert genuine.description == "revision 1.0, 1799 points, up to 100000 points/s, idle"
    assert false.port == "127.0.0.1"
    assert all("\x1b" not in dac.name + dac.description for dac in found)


def test_a_scan_lists_an_idn_device(tmp_path):
    device = DeviceProcess(serve_idn, tmp_path)
    found = find_idn_devices(MonotonicClock(), 1.0, (device.address, 7255))
    device.finish()
    (dac,) = found
    assert (dac.transport, dac.name, dac.port) == ("idn", "IDN 01020304050607", device.address)
    assert dac.description == "emulated, protocol 0.1, in order"


@pytest.mark.parametrize("data", [b"", bytes(35), bytes(37)])
def test_a_datagram_of_another_length_is_no_device(data):
    port = free_udp_port()
    pid = os.fork()
    if not pid:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as liar:
            while True:
                liar.sendto(data, ("127.0.0.1", port))
    try:
        assert find_ether_dreams(MonotonicClock(), 0.2, port) == []
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
