"""Discovery behind several network ports, in network namespaces, and the choice among several Helios."""

import ctypes
import os
import socket
import subprocess
import time
from array import array
from pathlib import Path
from types import SimpleNamespace

import pytest
import usb.backend

from dac.bench import build_config
from dac.emulated_ether_dream import EtherDreamCore
from dac.emulated_helios import EmulatedHelios
from dac.emulated_idn import IdnCore
from optodrive.core.clock import ManualClock, MonotonicClock
from optodrive.core.errors import InputError
from optodrive.link.dac.devices.helios import Helios
from optodrive.link.dac.discovery import find_ether_dreams, find_idn_devices

CLONE_NEWNET = 0x40000000
PORTS = {"port0": "10.77.0", "port1": "169.254.9", "port2": "192.168.77"}
"""Network ports of the computer, and the networks behind them: none has a default route."""


def ip(*words):
    return subprocess.run(["ip", *words], capture_output=True, text=True)


def serve(namespace, address, started):
    """Serve one IDN device and one Ether Dream in a namespace until killed."""
    with Path(f"/run/netns/{namespace}").open() as file:
        ctypes.CDLL(None).setns(file.fileno(), CLONE_NEWNET)
    idn, ether_dream = IdnCore(), EtherDreamCore()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as beacon,
    ):
        radio.bind(("", 7255))
        radio.settimeout(0.05)
        beacon.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        beacon.bind((address, 0))
        os.write(started, b".")
        while True:
            beacon.sendto(ether_dream.broadcast(), ("255.255.255.255", 7654))
            try:
                data, source = radio.recvfrom(2048)
            except TimeoutError:
                continue
            for answer in idn.receive(data, time.monotonic(), source):
                radio.sendto(answer, source)


@pytest.fixture
def networks():
    """Devices behind three network ports of a computer, which is a namespace of its own."""
    host = f"opto{os.getpid()}h"
    if os.geteuid() != 0 or ip("netns", "add", host).returncode:
        pytest.skip("network namespaces need root and the capability for them")
    names, pids = [host], []
    try:
        for number, (port, network) in enumerate(PORTS.items()):
            name = f"opto{os.getpid()}d{number}"
            names.append(name)
            for words in (
                f"netns add {name}",
                f"-n {host} link add {port} type veth peer name eth0 netns {name}",
                f"-n {host} addr add {network}.1/24 dev {port}",
                f"-n {host} link set {port} up",
                f"-n {name} addr add {network}.2/24 dev eth0",
                f"-n {name} link set eth0 up",
            ):
                assert not ip(*words.split()).returncode, words
            started, tell = os.pipe()
            pid = os.fork()
            if not pid:
                try:
                    serve(name, f"{network}.2", tell)
                finally:
                    os._exit(1)
            pids.append(pid)
            os.close(tell)
            assert os.read(started, 1), "the device did not start"
            os.close(started)
        yield host
    finally:
        for pid in pids:
            os.kill(pid, 9)
            os.waitpid(pid, 0)
        for name in names:
            ip("netns", "del", name)


def find_in(namespace, find):
    """Return the addresses that a search in a namespace finds."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            with Path(f"/run/netns/{namespace}").open() as file:
                ctypes.CDLL(None).setns(file.fileno(), CLONE_NEWNET)
            os.write(writing, " ".join(dac.port for dac in find()).encode() + b"\n")
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        found = pipe.read().split()
    os.waitpid(pid, 0)
    return found


@pytest.mark.parametrize("find", [find_idn_devices, find_ether_dreams])
def test_devices_behind_every_network_port_are_found(networks, find):
    found = find_in(networks, lambda: find(MonotonicClock(), 3.0))
    assert found == sorted(f"{network}.2" for network in PORTS.values())


def test_one_broadcast_for_all_ports_finds_none_without_a_route(networks):
    """Mutant: the scan goes where the default route leads."""
    assert find_in(networks, lambda: find_idn_devices(MonotonicClock(), 0.5, ("255.255.255.255", 7255))) == []


class UsbBus(usb.backend.IBackend):
    """Several emulated Helios on one bus. devices: (name, serial number or None)"""

    def __init__(self, clock, *devices):
        self.boards = [EmulatedHelios(clock, name=name) for name, _ in devices]
        self.serials = [serial for _, serial in devices]

    def enumerate_devices(self):
        return range(len(self.boards))

    def get_device_descriptor(self, number):
        fields = vars(self.boards[number].get_device_descriptor("helios"))
        return SimpleNamespace(**fields | {"address": number + 1, "iSerialNumber": 3 if self.serials[number] else 0})

    def ctrl_transfer(self, number, request_type, request, value, index, data, timeout):
        text = b"\x09\x04" if value & 0xFF == 0 else self.serials[number].encode("utf-16-le")
        answer = bytes([len(text) + 2, 3]) + text
        data[: len(answer)] = array("B", answer)
        return len(answer)


def _delegate(name):
    return lambda bus, number, *rest: getattr(bus.boards[number], name)(number, *rest)


for _name in (
    *("get_configuration_descriptor", "get_interface_descriptor", "get_endpoint_descriptor", "open_device"),
    *("close_device", "get_configuration", "claim_interface", "release_interface", "set_interface_altsetting"),
    *("intr_write", "intr_read", "bulk_write"),
):
    setattr(UsbBus, _name, _delegate(_name))


TWO = (("Helios 1", "A1"), ("Helios 2", "B2"))


def open_one(*devices, **board):
    clock = ManualClock()
    bus = UsbBus(clock, *devices)
    with Helios(build_config(**board).board, clock, bus) as helios:
        assert [board.claimed for board in bus.boards].count(True) == 1
        name, identity = helios.name, helios.identity
    assert not any(board.device.shutter or board.device.light() for board in bus.boards)
    return name, identity


@pytest.mark.parametrize(
    ("board", "found"),
    [
        ({"uid": "Helios 1"}, ("Helios 1", "A1")),
        ({"uid": "Helios 2"}, ("Helios 2", "B2")),
        ({"serial_number": "A1"}, ("Helios 1", "A1")),
        ({"serial_number": "B2"}, ("Helios 2", "B2")),
        ({"serial_number": "B2", "uid": "Helios 2"}, ("Helios 2", "B2")),
    ],
)
def test_one_of_two_helios_is_opened_by_its_name_or_serial_number(board, found):
    assert open_one(*TWO, **board) == found


@pytest.mark.parametrize(
    ("devices", "board", "words"),
    [
        (TWO, {}, r"board\.uid: got '', expected the name of one, or .*'Helios 1' \(.*'A1'\), 'Helios 2' \(.*'B2'\)"),
        (TWO, {"uid": "Helios 3"}, r"board\.uid: got 'Helios 3', expected .*'Helios 1'.*'Helios 2'"),
        ((("H", None), ("H", None)), {"uid": "H"}, r"board\.uid: got 'H', expected .*without serial_number.*without"),
        (TWO, {"serial_number": "C3"}, r"board\.serial_number: got 'C3', expected .*'A1'.*'B2'"),
        (TWO, {"serial_number": "A1", "uid": "Helios 2"}, r"board\.uid: got 'Helios 2', .* one is 'Helios 1'"),
        ((("H", None),), {"serial_number": "A1"}, r"board\.serial_number: got 'A1', expected .*without serial_number"),
    ],
)
def test_an_ambiguous_or_missing_helios_is_refused_with_the_list(devices, board, words):
    with pytest.raises(InputError, match=words) as caught:
        open_one(*devices, **board)
    assert "\n" not in str(caught.value)


def test_helios_without_a_serial_number_share_an_identity():
    assert open_one(("Helios 1", None)) == ("Helios 1", "any")
