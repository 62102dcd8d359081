"""Discovery of laser DACs, for a list only.

Anybody in the network can answer a search. No playback follows one: a network DAC is played at its configured address.
"""

import errno
import socket
from dataclasses import dataclass
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, escape_unprintable
from optodrive.link.dac.formats import ether_dream, idn

LISTENING_S = 1.5
"""An Ether Dream states itself once per second."""
ANSWERING_S = 0.5
DATAGRAM_BYTES = 2048
FOUND_MAX = 64
"""Found devices that are listed; a flood of false ones ends here."""


@dataclass(frozen=True)
class FoundDac:
    """A laser DAC that was seen.

    port: value of board.port; '' for a Helios
    """

    transport: str
    name: str
    port: str
    description: str


def find_dacs(clock: Clock) -> list[FoundDac]:
    """Return the laser DACs on USB and in the network."""
    return [*find_helios(), *find_ether_dreams(clock), *find_idn_devices(clock)]


def find_helios(backend: Any = None) -> list[FoundDac]:
    """Return the Helios DACs on USB, none without libusb. backend: of pyusb, None for libusb."""
    import usb.core

    from optodrive.link.dac.devices.helios import PRODUCT_ID, VENDOR_ID

    try:
        devices = list(usb.core.find(True, backend, idVendor=VENDOR_ID, idProduct=PRODUCT_ID))
    except usb.core.NoBackendError:
        return []
    return [
        FoundDac("helios", "Helios", "", f"USB bus {device.bus} device {device.address}; `info` asks for its name")
        for device in devices
    ]


def find_ether_dreams(
    clock: Clock, listening_s: float = LISTENING_S, udp_port: int = ether_dream.BROADCAST_PORT
) -> list[FoundDac]:
    """Return the Ether Dreams whose broadcasts arrive within listening_s. Raise InputError if the port is taken."""
    found: dict[str, FoundDac] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
        radio.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            radio.bind(("", udp_port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise InputError("UDP port", udp_port, "a free one: another program listens for Ether Dreams") from None
        until_s = clock.now_s() + listening_s
        while len(found) < FOUND_MAX and (left_s := until_s - clock.now_s()) > 0.0:
            radio.settimeout(left_s)
            try:
                data, (host, _) = radio.recvfrom(DATAGRAM_BYTES)
            except TimeoutError:
                break
            dac = _parse_broadcast(data, host)
            if dac is not None:
                found.setdefault(dac.port, dac)
    return sorted(found.values(), key=lambda dac: dac.port)


def find_idn_devices(
    clock: Clock, listening_s: float = ANSWERING_S, address: tuple[str, int] = ("255.255.255.255", idn.UDP_PORT)
) -> list[FoundDac]:
    """Return the IDN devices that answer a scan of the local network within listening_s."""
    found: dict[str, FoundDac] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
        radio.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            radio.sendto(idn.PACKET.pack(idn.SCAN, 0, 1), address)
        except OSError:  # a computer without a network
            return []
        until_s = clock.now_s() + listening_s
        while len(found) < FOUND_MAX and (left_s := until_s - clock.now_s()) > 0.0:
            radio.settimeout(left_s)
            try:
                data, (host, _) = radio.recvfrom(DATAGRAM_BYTES)
            except TimeoutError:
                break
            dac = _parse_scan(data, host)
            if dac is not None:
                found.setdefault(dac.port, dac)
    return sorted(found.values(), key=lambda dac: dac.port)


def _parse_scan(data: bytes, host: str) -> FoundDac | None:
    """Return the IDN device that a datagram states, None if it states none."""
    if len(data) < idn.PACKET.size + idn.SCAN_BODY.size or data[0] != idn.SCAN_ANSWER:
        return None
    _, version, status, _, unit, name = idn.SCAN_BODY.unpack_from(data, idn.PACKET.size)
    state = "out of order" if status & (idn.MALFUNCTION | idn.OFFLINE) else "in order"
    host_name = escape_unprintable(idn.decode_name(name))
    return FoundDac("idn", idn.name_unit(unit), host, f"{host_name}, protocol {version >> 4}.{version & 15}, {state}")


def _parse_broadcast(data: bytes, host: str) -> FoundDac | None:
    """Return the Ether Dream that a datagram states, None if it states none."""
    if len(data) != ether_dream.BROADCAST.size + ether_dream.STATUS.size:
        return None
    hardware, hardware_revision, software_revision, capacity, rate_max = ether_dream.BROADCAST.unpack_from(data)
    status = ether_dream.Status.from_bytes(data[ether_dream.BROADCAST.size :])
    name = ":".join(f"{byte:02x}" for byte in hardware)
    state = ("idle", "prepared", "playing")[status.playback] if status.playback < 3 else "unknown"
    if status.engine == ether_dream.EMERGENCY_STOP:
        state = "in an emergency stop"
    description = (
        f"revision {hardware_revision}.{software_revision}, {capacity} points, up to {rate_max} points/s, {state}"
    )
    return FoundDac("ether_dream", name, host, escape_unprintable(description))
