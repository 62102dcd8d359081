"""Discovery of laser DACs, for a list only.

Anybody in the network can answer a search. No playback follows one: a network DAC is played at its configured address.
"""

import ctypes
import errno
import fcntl
import selectors
import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, escape_unprintable
from optodrive.link.dac.formats import ether_dream, idn
from optodrive.link.dac.formats.helios import PRODUCT_ID, VENDOR_ID

LISTENING_S = 1.5
"""An Ether Dream states itself once per second."""
ANSWERING_S = 0.5
DATAGRAM_BYTES = 2048
FOUND_MAX = 64
"""Found devices that are listed; a flood of false ones ends here."""
BROADCAST_ADDRESS = "255.255.255.255"
LIST_ADDRESSES = 0x8912
"""SIOCGIFCONF: the IPv4 addresses of all interfaces that are up."""
INTERFACE = struct.Struct("16sHH4s16x" if struct.calcsize("P") == 8 else "16sHH4s8x")
"""`struct ifreq`: name, and a sockaddr_in of family, port and address."""
INTERFACES_MAX = 256


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

    from optodrive.link.transport.usb_bulk import describe_device

    try:
        devices = list(usb.core.find(True, backend, idVendor=VENDOR_ID, idProduct=PRODUCT_ID))
    except usb.core.NoBackendError:
        return []
    return [
        FoundDac("helios", "Helios", "", f"USB {describe_device(device)}; `info` asks for its name")
        for device in devices
    ]


def find_ether_dreams(
    clock: Clock, listening_s: float = LISTENING_S, udp_port: int = ether_dream.BROADCAST_PORT
) -> list[FoundDac]:
    """Return the Ether Dreams whose broadcasts arrive within listening_s. Raise InputError if the port is taken."""
    return _collect(_parse_broadcast(*each) for each in _hear_broadcasts(clock, listening_s, udp_port))


def hear_ether_dream(
    host: str, clock: Clock, listening_s: float = LISTENING_S, udp_port: int = ether_dream.BROADCAST_PORT
) -> str | None:
    """Return the hardware address that the Ether Dream at an address broadcasts, None if nothing is heard of it."""
    with suppress(InputError, OSError):
        for data, source in _hear_broadcasts(clock, listening_s, udp_port):
            dac = _parse_broadcast(data, source)
            if source == host and dac is not None:
                return dac.name
    return None


def _hear_broadcasts(clock: Clock, listening_s: float, udp_port: int) -> Iterator[tuple[bytes, str]]:
    """Yield the datagrams that arrive on any interface, with their source. Raise InputError if the port is taken."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
        radio.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            radio.bind(("", udp_port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise InputError("UDP port", udp_port, "a free one: another program listens for Ether Dreams") from None
        yield from _receive([radio], clock, listening_s)


def find_idn_devices(
    clock: Clock, listening_s: float = ANSWERING_S, address: tuple[str, int] | None = None
) -> list[FoundDac]:
    """Return the IDN devices that answer a scan within listening_s.

    address: that is asked, by default all devices behind every interface
    """
    target = (BROADCAST_ADDRESS, idn.UDP_PORT) if address is None else address
    with ExitStack() as exit_stack:
        radios = []
        for source in list_addresses() if address is None else [""]:
            radio = exit_stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            radio.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            with suppress(OSError):  # an interface that has just gone
                radio.bind((source, 0))  # a broadcast leaves by the interface whose address its source is
                radio.sendto(idn.PACKET.pack(idn.SCAN, 0, 1), target)
                radios.append(radio)
        return _collect(_parse_scan(*each) for each in _receive(radios, clock, listening_s))


def list_addresses() -> list[str]:
    """Return the IPv4 addresses of this computer on all interfaces but loopback."""
    buffer = bytearray(INTERFACES_MAX * INTERFACE.size)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
        view = (ctypes.c_char * len(buffer)).from_buffer(buffer)
        request = struct.pack("iP", len(buffer), ctypes.addressof(view))
        size, _ = struct.unpack("iP", fcntl.ioctl(radio, LIST_ADDRESSES, request))
    entries = (INTERFACE.unpack_from(buffer, begin) for begin in range(0, size, INTERFACE.size))
    addresses = [socket.inet_ntoa(address) for _, _, _, address in entries]
    return [address for address in addresses if not address.startswith("127.")]


def _receive(radios: list[socket.socket], clock: Clock, listening_s: float) -> Iterator[tuple[bytes, str]]:
    """Yield datagrams with their source until listening_s has passed."""
    until_s = clock.now_s() + listening_s
    with selectors.DefaultSelector() as selector:
        for radio in radios:
            selector.register(radio, selectors.EVENT_READ)
        while radios and (left_s := until_s - clock.now_s()) > 0.0:
            for key, _ in selector.select(left_s):
                with suppress(OSError):  # what an earlier datagram met
                    data, (host, _) = key.fileobj.recvfrom(DATAGRAM_BYTES)  # type: ignore[union-attr]
                    yield data, host


def _collect(dacs: Iterator[FoundDac | None]) -> list[FoundDac]:
    """Return the first dac of each address, in their order."""
    found: dict[str, FoundDac] = {}
    for dac in dacs:
        if dac is not None:
            found.setdefault(dac.port, dac)
            if len(found) == FOUND_MAX:
                break
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
