"""Bridge from a UDP port, to which a live source sends OSC, to the stream of a display.

The heights of all pixels stay until a message changes them. All packets that wait are applied in order before one
frame goes out with the newest heights. OSC knows no secret: the port takes packets of this computer only, or of
addresses that are named, and the bridge has the rights of its own token.
"""

import select
import socket
import time
from collections.abc import Callable, Sequence
from ipaddress import ip_address
from math import isfinite
from typing import NamedTuple, Protocol

import numpy as np

from optodrive.client.osc_packets import CODE, Argument, OscMessage, build_message, parse_packet
from optodrive.client.stream import FrameCounts
from optodrive.core.errors import InputError, OptodriveError, Unquoted, suggest_nearest
from optodrive.core.types.arrays import FloatArray
from optodrive.daemon.responses.messages import FrameResult

HEIGHT_MAX_UM = 1000.0
"""Largest height of a message, µm."""
PACKET_BYTES = 65_535
PACKETS_MAX = 1000
"""Packets that are applied before a frame goes out, however many wait."""
SILENCE_S = 2.0
"""Time without a packet after which heights that stand are cleared: the source is gone."""
REPORT_S = 10.0
ADDRESSES = ("/pixel", "/heights", "/clear", "/stop")
NOT_SHOWN = ("refused", "failed", "stopped")


class FrameStream(Protocol):
    """A stream of frames, as `Display.stream()` opens one."""

    @property
    def counts(self) -> FrameCounts:
        """Number of frames shown and superseded so far."""

    def send(self, heights_um: FloatArray) -> int:
        """Show a frame. Return its number."""

    def results(self) -> list[FrameResult]:
        """Return the results since the last call."""


class OscHeights:
    """Heights of all pixels, µm, as messages set them.

    scale_um: height of the value 1
    """

    def __init__(self, pixel_count: int, scale_um: float) -> None:
        self.heights_um = np.zeros(pixel_count)
        self._scale_um = scale_um

    def apply(self, message: OscMessage) -> None:
        """Set the heights that a message states. Raise InputError, and change nothing, for one that is wrong."""
        address, arguments = message
        if address == "/clear":
            self.heights_um[:] = 0.0
        elif address == "/heights":
            if len(arguments) != len(self.heights_um):
                found = Unquoted(f"{len(arguments)} heights")
                raise InputError(address, found, f"one for each of {len(self.heights_um)} pixels", code=CODE)
            self.heights_um[:] = [self._convert(each, address) for each in arguments]
        elif address == "/pixel":
            if not arguments or len(arguments) % 2:
                found = Unquoted(f"{len(arguments)} arguments")
                raise InputError(address, found, "pixel and height, or several of these", code=CODE)
            pairs = zip(arguments[::2], arguments[1::2], strict=True)
            heights = [(self._find(pixel, address), self._convert(height, address)) for pixel, height in pairs]
            for pixel, height_um in heights:
                self.heights_um[pixel] = height_um
        elif address.startswith("/pixel/"):
            number = address.removeprefix("/pixel/")
            if len(arguments) != 1:
                raise InputError(address, Unquoted(f"{len(arguments)} arguments"), "one height", code=CODE)
            is_number = number.isascii() and number.isdigit() and len(number) < 10
            pixel = self._find(int(number) if is_number else number, address)
            self.heights_um[pixel] = self._convert(arguments[0], address)
        else:
            expected = f"a known one, {suggest_nearest(address[:60], list(ADDRESSES))}"
            raise InputError("OSC address", address[:60], expected, code=CODE)

    def _find(self, pixel: Argument, address: str) -> int:
        if type(pixel) is not int or not 0 <= pixel < len(self.heights_um):
            raise InputError(address, pixel, f"a pixel as an integer, 0…{len(self.heights_um) - 1}", "unknown_pixel")
        return pixel

    def _convert(self, value: Argument, address: str) -> float:
        height_um = self._scale_um * value if isinstance(value, int | float) else -1.0
        if not (isfinite(height_um) and 0.0 <= height_um <= HEIGHT_MAX_UM):
            unit = "in µm" if self._scale_um == 1.0 else f"in units of {self._scale_um:g} µm"
            expected = f"a height {unit}, 0 to {HEIGHT_MAX_UM / self._scale_um:g}"
            raise InputError(address, value, expected, code="bad_target")
        return height_um


class Place(NamedTuple):
    """An address and a port of UDP."""

    host: str
    port: int


def parse_place(text: str, option: str) -> Place:
    """Return the place of a text such as 127.0.0.1:9000. Raise InputError for other text."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    try:
        ip_address(host)
    except ValueError:
        host = ""
    if not host or not (port.isascii() and port.isdigit() and int(port) <= 65_535):
        raise InputError(option, text, "an address and a port such as 127.0.0.1:9000")
    return Place(host, int(port))


def parse_sender(text: str) -> str:
    """Return the address of a sender. Raise InputError for other text."""
    try:
        return str(ip_address(text))
    except ValueError:
        raise InputError("--from", text, "an address such as 192.168.1.20") from None


class UdpPort:
    """A UDP port that takes packets of some senders only.

    place: where it listens; refused: packets of others
    """

    def __init__(self, place: Place, senders: Sequence[str]) -> None:
        """Open the port. Raise InputError if it cannot be opened, or is open to others and names no sender."""
        self._senders = set(senders)
        if not ip_address(place.host).is_loopback and not senders:
            expected = "--from with the addresses of the senders, because OSC knows no secret"
            raise InputError("--listen", f"{place.host}:{place.port}", expected)
        family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind(place)
        except OSError as error:
            self._socket.close()
            expected = f"an address and a free port of this computer ({error.strerror})"
            raise InputError("--listen", f"{place.host}:{place.port}", expected) from None
        self._socket.setblocking(False)
        self.place = Place(*self._socket.getsockname()[:2])
        self.refused = 0

    def receive(self, wait_s: float) -> list[bytes]:
        """Return the packets that wait, in order, or those that come first within a time."""
        packets: list[bytes] = []
        if not select.select([self._socket], [], [], wait_s)[0]:
            return packets
        while len(packets) < PACKETS_MAX:
            try:
                data, sender = self._socket.recvfrom(PACKET_BYTES)
            except OSError:  # none is left, or an answer of ours found nobody
                break
            host = ip_address(sender[0])
            if str(host) in self._senders if self._senders else host.is_loopback:
                packets.append(data)
            else:
                self.refused += 1
        return packets

    def send(self, data: bytes, place: Place) -> None:
        """Send a packet. It may be lost."""
        try:
            self._socket.sendto(data, place)
        except OSError:
            return

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


class PacketPort(Protocol):
    """A port of packets, as `UdpPort` is one."""

    def receive(self, wait_s: float) -> list[bytes]:
        """Return the packets that wait."""

    def send(self, data: bytes, place: Place) -> None:
        """Send a packet."""


class OscBridge:
    """The bridge, run step by step.

    stop: stops the display; report: takes a line; stands: whether the stream's frames stand
    reply: where the rates go each second as /shown, with frames sent and shown per second and all shown
    """

    def __init__(
        self,
        port: PacketPort,
        stream: FrameStream,
        heights: OscHeights,
        stop: Callable[[], object],
        report: Callable[[str], None],
        stands: bool = False,
        reply: Place | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._port, self._stream, self._heights, self._stop, self._report = port, stream, heights, stop, report
        self._stands, self._reply, self._now_s = stands, reply, now_s
        self._period_s = REPORT_S if reply is None else 1.0
        self._heard_s = self._reported_s = now_s()
        self._sent = self._sent_before = self._shown_before = 0
        self._reported = self._problem = ""

    def run(self) -> None:
        """Run until an exception ends it."""
        while True:
            self.step()

    def step(self, wait_s: float = 0.1) -> None:
        """Wait for packets, send a frame with the newest heights if there were any, and report."""
        packets = self._port.receive(wait_s)
        now_s = self._now_s()
        if packets:
            self._heard_s = now_s
            for data in packets:
                self._apply(data)
            self._send()
        elif self._stands and self._heights.heights_um.any() and now_s > self._heard_s + SILENCE_S:
            self._report(f"no packet for {SILENCE_S:g} s: all heights are cleared")
            self._heights.heights_um[:] = 0.0
            self._send()
        self._take_results()
        if now_s >= self._reported_s + self._period_s:
            self._report_rates(now_s)

    def _apply(self, data: bytes) -> None:
        try:
            for message in parse_packet(data):
                if message.address == "/stop":
                    self._heights.heights_um[:] = 0.0
                    self._report("stop: the board is disarmed")
                    self._stop()
                else:
                    self._heights.apply(message)
        except InputError as error:
            if str(error) != self._reported:  # a source repeats its mistakes
                self._report(str(error))
            self._reported = str(error)

    def _send(self) -> None:
        try:
            self._stream.send(self._heights.heights_um)
            self._sent += 1
        except OptodriveError as error:
            self._tell(str(error))

    def _take_results(self) -> None:
        for result in self._stream.results():
            if result.status in NOT_SHOWN:
                self._tell(result.error or (result.problem.detail if result.problem else result.status))
            elif result.executed:
                self._problem = ""

    def _tell(self, problem: str) -> None:
        if problem != self._problem:
            self._report(f"not shown: {problem}")
        self._problem = problem

    def _report_rates(self, now_s: float) -> None:
        span_s, counts = now_s - self._reported_s, self._stream.counts
        sent_hz, shown_hz = (self._sent - self._sent_before) / span_s, (counts.shown - self._shown_before) / span_s
        if self._reply is not None:
            self._port.send(build_message("/shown", sent_hz, shown_hz, counts.shown), self._reply)
        elif self._sent != self._sent_before:
            self._report(
                f"{sent_hz:.1f} frames/s sent, {shown_hz:.1f} shown; in all {self._sent} sent, {counts.shown} shown, "
                f"{counts.superseded} superseded, {counts.other} refused or stopped"
            )
        self._reported_s, self._sent_before, self._shown_before = now_s, self._sent, counts.shown
