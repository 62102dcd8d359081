"""Driver of an IDN device over UDP: scan, close, and wave chunks that are each acknowledged.

The protocol does not tell how much is buffered, so the host's clock paces the chunks, and each one waits for the
acknowledgement of the one before it. A chunk is never sent twice: a device that does not look at time stamps would play
it twice.
"""

import socket
from collections.abc import Callable
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, escape_unprintable
from optodrive.core.quantity import format_quantity
from optodrive.device.config_sections import BoardSection
from optodrive.link.dac.formats import idn as wire
from optodrive.link.dac.formats.base import Chunk
from optodrive.link.dac.laser_dac import LaserDac, parse_address

ANSWER_TIMEOUT_S = 0.1
QUERY_TRIES = 3
"""Number of times that a scan and a close are sent; unlike chunks they may arrive twice."""
DATAGRAM_BYTES = 2048
REFUSALS = {wire.OCCUPIED: "another client plays on it", wire.EXCLUDED: "it excludes this client's group"}


def open_udp(address: tuple[str, int]) -> socket.socket:
    """Return a UDP socket that receives from one address only."""
    radio = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    radio.connect(address)
    return radio


class Idn(LaserDac):
    """One IDN device. It emits only while it has samples.

    connect: open_udp, or the same for an emulated device
    """

    transport = "idn"

    def __init__(self, board: BoardSection, clock: Clock, connect: Callable[..., Any] = open_udp) -> None:
        super().__init__(board, clock)
        self._connect = connect
        self._sequence = 0
        self._end_s = 0.0

    def open(self) -> None:
        """Identify and close the device.

        Raise InputError if it is not the configured one, LinkError if it does not answer or is out of order.
        """
        address = parse_address(self.board.port, wire.UDP_PORT)
        try:
            self._link = self._connect(address)
        except OSError as error:
            raise LinkError(f"no IDN device answers at {self.board.port}: {error.strerror or error}") from None
        try:
            self._identify()
            self.stop()
        except BaseException:
            self._release()
            raise

    def _identify(self) -> None:
        answer = self._query(wire.SCAN, b"", wire.SCAN_ANSWER)
        if answer is None or len(answer) < wire.SCAN_BODY.size:
            raise LinkError(f"no IDN device answers at {self.board.port}")
        _, version, status, _, unit, host = wire.SCAN_BODY.unpack_from(answer)
        self.name = wire.name_unit(unit)
        self.identity = unit[1 : 1 + unit[0]].hex() if any(unit[1 : 1 + unit[0]]) else None
        self.firmware = f"protocol {version >> 4}.{version & 15} of {escape_unprintable(wire.decode_name(host))}"
        if self.board.uid and self.board.uid != self.name:
            expected = f"the IDN device of this unit; the one at {self.board.port} is '{self.name}'"
            raise InputError("board.uid", self.board.uid, expected, "board")
        if status & (wire.MALFUNCTION | wire.OFFLINE):
            raise LinkError(f"the IDN device is out of order or in an emergency stop (status {status:#04x})")

    def stop(self) -> None:
        """Close the channel and the connection. Raise LinkError if the device may not have received it."""
        self._end_s = self._clock.now_s()
        closing = wire.build_configuration(wire.CLOSING)
        if self._query(wire.CLOSE_ACKNOWLEDGED, closing, wire.ACKNOWLEDGEMENT) is None:
            bound = f"it plays for at most {format_quantity(self.format.host_loss_max_s, 's')} more"
            raise LinkError(f"the IDN device may not have received the stop, {bound}: it does not answer")

    def _start(self) -> None:
        """Open the channel. Raise LinkError unless the device acknowledges it."""
        self._send_message(wire.build_configuration(wire.CONFIGURATION))

    def is_ready(self) -> bool:
        """Return whether another chunk stays within the lead."""
        chunk_s = self.format.points_max * self.format.point_ticks / self.format.clock_hz
        return self._end_s - self._clock.now_s() <= wire.LEAD_S - chunk_s

    def _send(self, chunk: Chunk) -> None:
        """Send one chunk. Raise LinkError unless the device acknowledges it."""
        self._send_message(chunk.data)
        self._end_s = max(self._end_s, self._clock.now_s()) + chunk.duration_s

    def _send_message(self, message: bytes) -> None:
        answer = self._exchange(wire.MESSAGE_ACKNOWLEDGED, message, wire.ACKNOWLEDGEMENT)
        if answer is None or len(answer) < wire.ACKNOWLEDGEMENT_BODY.size:
            raise LinkError("the IDN device did not acknowledge a chunk; nothing more is emitted")
        _, result, flags = wire.ACKNOWLEDGEMENT_BODY.unpack_from(answer)
        if result != wire.ACCEPTED:
            cause = REFUSALS.get(result, f"result {result:#04x}")
            raise LinkError(f"the IDN device refused a chunk: {cause}; nothing more is emitted")
        if flags & wire.CHANNEL_CLOSED:
            raise LinkError("the IDN device refused a chunk: its channel is closed; nothing more is emitted")

    # --- transfers ----------------------------------------------------------------------------------------------

    def _query(self, command: int, body: bytes, expected: int) -> bytes | None:
        for _ in range(QUERY_TRIES):
            answer = self._exchange(command, body, expected)
            if answer is not None:
                return answer
        return None

    def _exchange(self, command: int, body: bytes, expected: int) -> bytes | None:
        """Send a packet and return the body of the answer with its sequence, None without one."""
        if self._link is None:
            raise LinkError("the IDN device is not open")
        self._sequence = (self._sequence + 1) & 0xFFFF
        until_s = self._clock.now_s() + ANSWER_TIMEOUT_S
        try:
            self._link.send(wire.PACKET.pack(command, 0, self._sequence) + body)
            while (left_s := until_s - self._clock.now_s()) > 0.0:
                self._link.settimeout(left_s)
                data = self._link.recv(DATAGRAM_BYTES)
                if len(data) >= wire.PACKET.size:
                    answered, _, sequence = wire.PACKET.unpack_from(data)
                    if (answered, sequence) == (expected, self._sequence):
                        return bytes(data[wire.PACKET.size :])
        except TimeoutError:
            pass
        except OSError as error:
            raise LinkError(f"link to the IDN device lost: {error.strerror or error}") from None
        return None
