"""Driver of an Ether Dream over TCP: status, stop, and data commands that each end dark.

The device plays from a buffer and stops, dark and with centred mirrors, when it runs empty. What it has received of a
plan then must not go on, because the mirrors are elsewhere: every refusal and every unexpected state ends playback.
"""

import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError
from optodrive.core.quantity import format_quantity
from optodrive.device.config_sections import BoardSection
from optodrive.link.dac.discovery import hear_ether_dream
from optodrive.link.dac.formats import ether_dream as wire
from optodrive.link.dac.formats.base import Chunk
from optodrive.link.dac.formats.ether_dream import Status
from optodrive.link.dac.laser_dac import LaserDac, parse_address

CONNECT_TIMEOUT_S = 2.0
ANSWER_TIMEOUT_S = 0.5
"""Much longer than the buffer lasts: a device that answers later has stopped."""
REFUSALS = {
    wire.FULL: "its buffer is full",
    wire.INVALID: "it ran out of points and stopped",
    wire.STOPPED: "it is in an emergency stop",
}
CLEARABLE = wire.ESTOP_BY_PACKET | wire.ESTOP_BY_LINK
"""Causes of an emergency stop that no person and no temperature is behind."""


class EtherDream(LaserDac):
    """One Ether Dream. It emits only while it plays.

    connect: of the module socket; hear: hears its hardware address; or the same for an emulated device
    """

    transport = "ether_dream"

    def __init__(
        self,
        board: BoardSection,
        clock: Clock,
        connect: Callable[..., Any] = socket.create_connection,
        hear: Callable[[str, Clock], str | None] = hear_ether_dream,
    ) -> None:
        super().__init__(board, clock)
        self._connect, self._hear = connect, hear
        self._begun = False
        self._protocol = 0

    def open(self) -> None:
        """Connect to the DAC and stop it.

        Raise InputError if it is not the configured one, LinkError if the link fails or it is in an emergency stop.
        """
        address = parse_address(self.board.port, wire.TCP_PORT)
        self.name = f"Ether Dream at {self.board.port}"
        try:
            self._link = self._connect(address, timeout=CONNECT_TIMEOUT_S)
            self._link.settimeout(ANSWER_TIMEOUT_S)
        except OSError as error:
            raise LinkError(f"no Ether Dream answers at {self.board.port}: {error.strerror or error}") from None
        try:
            self._read_answer(wire.PING)  # sent by the device itself
            self.firmware = f"protocol {self._protocol}"
            if self.board.uid and self.board.uid != (self.find_identity() or ""):
                heard = f"has '{self.identity}'" if self.identity else "tells none, for it is not heard on UDP 7654"
                expected = f"the Ether Dream of this hardware address; the one at {self.board.port} {heard}"
                raise InputError("board.uid", self.board.uid, expected, "board")
            self.stop()
        except BaseException:
            self._release()
            raise

    def find_identity(self) -> str | None:
        """Return its hardware address, which it broadcasts once per second and never tells its client."""
        if self.identity is None and self._link is not None:
            with suppress(OSError):  # a lost link, which the next command meets
                self.identity = self._hear(self._link.getpeername()[0], self._clock)
            self.name = self.identity or self.name
        return self.identity

    def stop(self) -> None:
        """Stop playback. Raise LinkError if the DAC may not have received the stop."""
        self._begun = False
        try:
            _, status = self._ask(wire.STOP)  # an idle device refuses it
        except LinkError as error:
            bound = f"it plays for at most {format_quantity(self.format.host_loss_max_s, 's')} more"
            raise LinkError(f"the Ether Dream may not have received the stop, {bound}: {error}") from None
        if status.playback != wire.IDLE:
            raise LinkError("the Ether Dream does not stop: cut the laser by its interlock")

    def _start(self) -> None:
        """Empty the buffer and make it accept points."""
        _, status = self._ask(wire.PING)
        if status.engine == wire.EMERGENCY_STOP:
            if status.engine_flags & ~CLEARABLE:
                raise LinkError(
                    f"the Ether Dream is in an emergency stop (flags {status.engine_flags:#x}): remove its cause, and "
                    "switch the DAC off and on"
                )
            self._command(wire.CLEAR)
        self._command(wire.PREPARE)

    def is_ready(self) -> bool:
        """Return whether at most one chunk is buffered. Raise LinkError if playback has stopped."""
        answer, status = self._ask(wire.PING)
        if status.engine != wire.READY_ENGINE:
            raise LinkError(f"the Ether Dream stopped: {REFUSALS[wire.STOPPED]}")
        if self._begun and status.playback != wire.PLAYING:
            raise LinkError(f"the Ether Dream stopped: {REFUSALS[wire.INVALID]}; nothing more is emitted")
        return answer == wire.ACCEPTED and status.fullness <= self.format.points_max

    def _send(self, chunk: Chunk) -> None:
        """Send one data command, and begin playback with the first one. Raise LinkError if it is refused."""
        self._command(wire.DATA, chunk.data[1:])
        if not self._begun:
            self._command(wire.BEGIN, wire.BEGIN_BODY.pack(0, self.format.points_per_s))
            self._begun = True

    # --- transfers ----------------------------------------------------------------------------------------------

    def _command(self, command: bytes, body: bytes = b"") -> None:
        answer, _ = self._ask(command, body)
        if answer != wire.ACCEPTED:
            cause = REFUSALS.get(answer, f"answer {answer!r}")
            raise LinkError(f"the Ether Dream refused command {command.decode()!r}: {cause}; nothing more is emitted")

    def _ask(self, command: bytes, body: bytes = b"") -> tuple[bytes, Status]:
        """Send a command and return the answer to it with the status."""
        if self._link is None:
            raise LinkError("the Ether Dream is not open")
        try:
            self._link.sendall(command + body)
        except OSError as error:
            raise LinkError(f"link to the Ether Dream lost: {error.strerror or error}") from None
        return self._read_answer(command)

    def _read_answer(self, command: bytes) -> tuple[bytes, Status]:
        data = b""
        while len(data) < wire.ANSWER_BYTES:
            try:
                received = self._link.recv(wire.ANSWER_BYTES - len(data))
            except OSError as error:  # also a time-out, whose late answer would be taken for the next one's
                self._release()
                raise LinkError(f"link to the Ether Dream lost: {error.strerror or error}") from None
            if not received:
                self._release()
                raise LinkError("link to the Ether Dream lost: it closed the connection")
            data += received
        if data[1:2] != command:
            self._release()
            raise LinkError(f"link to the Ether Dream lost: it answered {data[1:2]!r} to {command!r}")
        self._protocol = data[2]
        return data[:1], Status.from_bytes(data[2:])
