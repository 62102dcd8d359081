"""Driver of a Helios laser DAC over pyusb: version, name, status, shutter, stop and frames.

The driver omits the command that erases the firmware on purpose. The DAC has neither an interlock nor a watchdog for
the host: docs/reference/laser-dacs.md describes the consequences.
"""

from contextlib import suppress
from typing import Any

import usb.core
import usb.util

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, LocalProtocolError, escape_unprintable
from optodrive.core.quantity import format_quantity
from optodrive.device.config_sections import BoardSection
from optodrive.link.dac.formats.base import Chunk
from optodrive.link.dac.formats.helios import PRODUCT_ID, VENDOR_ID
from optodrive.link.dac.laser_dac import LaserDac
from optodrive.link.transport.base import build_lost_error, guard_opening, guard_port
from optodrive.link.transport.usb_bulk import describe_device, list_devices, read_serial_number, timeout_ms

INTERFACE, ALTERNATE_SETTING = 0, 1
COMMAND_ENDPOINT, ANSWER_ENDPOINT, FRAME_ENDPOINT = 0x06, 0x83, 0x02
ANSWER_BYTES = 32
STOP, SHUTTER, STATUS, VERSION, NAME, HOST_VERSION = 1, 2, 3, 4, 5, 7
PROTOCOL_VERSION = 11
"""Protocol version of this driver, in the numbering of the manufacturer's host software."""
READY = b"\x83\x01"
ENABLE_DELAY_S = 0.1
STOP_DELAY_S = 0.11
"""The DAC drops frames for 100 ms after a stop."""
COMMAND_TIMEOUT_S = ANSWER_TIMEOUT_S = 0.032
DRAIN_TIMEOUT_S = 0.005
DRAIN_READS_MAX = 16
QUERY_TRIES, ANSWER_TRIES = 2, 3
"""Number of times that a query is sent, and that its answer is awaited each time."""
STOP_TRIES = 3
ANY = "any"
"""Identity of all that state no serial number, as the published firmware: they share what is remembered of one."""
FRAME_TIMEOUT_S = 0.1
"""Longer than the USB transfer of the longest frame."""


class Helios(LaserDac):
    """One Helios DAC, connected by USB. Its light is off while its shutter is closed.

    backend: of pyusb, None for libusb
    """

    transport = "helios"

    def __init__(self, board: BoardSection, clock: Clock, backend: Any = None) -> None:
        super().__init__(board, clock)
        self._backend = backend
        self._answer_pending = False

    def open(self) -> None:
        """Claim, identify and stop the DAC.

        Raise InputError if it is not the configured one, LinkError if the link fails.
        """
        devices = list_devices(VENDOR_ID, PRODUCT_ID, self.board.serial_number, self._backend)
        device = devices[0] if len(devices) == 1 else self._choose(devices)
        self._claim(device)
        if self.board.uid not in ("", self.name):
            self._release()
            expected = f"the Helios of this name; the connected one is '{self.name}'"
            raise InputError("board.uid", self.board.uid, expected, "board")

    def _choose(self, devices: list[Any]) -> Any:
        """Return the device of several that has the configured name. Ask and stop all, for only they know it."""
        chosen, listed = [], []
        for device in devices:
            try:
                self._claim(device)
            except (InputError, LinkError):
                listed.append(f"one that cannot be opened ({describe_device(device)})")
                continue
            self._release()
            listed.append(f"{self.name!r} ({describe_device(device)})")
            if self.name == self.board.uid:
                chosen.append(device)
        if len(chosen) != 1:
            expected = f"the name of one, or its board.serial_number: {', '.join(listed)}"
            raise InputError("board.uid", self.board.uid, expected, "no_port")
        return chosen[0]

    def _claim(self, device: Any) -> None:
        """Claim, identify and stop a device."""
        self._link = device
        try:
            with guard_opening("the Helios", "board"):
                self._identify()
        except BaseException:
            self._release()
            raise

    def _identify(self) -> None:
        usb.util.claim_interface(self._link, INTERFACE)
        self._link.set_interface_altsetting(INTERFACE, ALTERNATE_SETTING)
        self._clock.sleep(ENABLE_DELAY_S)
        self._drain()
        self.firmware = str(int.from_bytes(self._query(VERSION, 4)[:4], "little"))
        self._command(HOST_VERSION, PROTOCOL_VERSION)
        self.name = escape_unprintable(self._query(NAME, 1).split(b"\0")[0].decode("ascii", "replace"))
        self.identity = read_serial_number(self._link) or ANY
        self.stop()

    def _release(self) -> None:
        device, self._link = self._link, None
        with suppress(Exception):  # the alternate setting without endpoints also stops it
            device.set_interface_altsetting(INTERFACE, 0)
        with suppress(Exception):
            usb.util.dispose_resources(device)

    # --- commands -----------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Stop playback, close the shutter and wait until the DAC accepts frames again.

        Raise LinkError if it may not have received one of the commands.
        """
        failures = [self._command_with_retries(STOP, 0), self._command_with_retries(SHUTTER, 0)]
        for failure in failures:
            if failure is not None:
                bound = f"it plays for at most {format_quantity(self.format.host_loss_max_s, 's')} more"
                raise LinkError(f"the Helios may not have received the stop and shutter commands, {bound}: {failure}")
        self._clock.sleep(STOP_DELAY_S)

    def _command_with_retries(self, command: int, value: int) -> LinkError | None:
        failure = None
        for _ in range(STOP_TRIES):
            try:
                self._command(command, value)
            except LinkError as error:
                failure = error
            else:
                return None
        return failure

    def _start(self) -> None:
        """Open the shutter."""
        self._command(SHUTTER, 1)

    def is_ready(self) -> bool:
        """Return whether the DAC accepts another frame. A missing or unexpected answer counts as not ready."""
        if self._answer_pending:
            self._drain()
        self._command(STATUS, 0)
        try:
            answer = self._read_answer()
        except usb.core.USBTimeoutError:
            answer = b""
        self._answer_pending = answer not in (READY, b"\x83\x00")
        return answer == READY

    def _send(self, chunk: Chunk) -> None:
        """Send one frame. Raise LinkError if the DAC does not accept the whole frame."""
        written_bytes = self._write(FRAME_ENDPOINT, chunk.data, FRAME_TIMEOUT_S)
        if written_bytes != len(chunk.data):
            raise LinkError(
                f"link to the Helios lost: it accepted {written_bytes} of a frame's {len(chunk.data)} bytes"
            )

    # --- transfers ----------------------------------------------------------------------------------------------

    def _command(self, command: int, value: int) -> None:
        if command not in (STOP, SHUTTER, STATUS, VERSION, NAME, HOST_VERSION):
            raise LocalProtocolError(f"command {command:#04x} is not one that this driver sends")
        if self._write(COMMAND_ENDPOINT, bytes([command, value]), COMMAND_TIMEOUT_S) != 2:
            raise LinkError("link to the Helios lost: it accepted half a command")

    def _write(self, endpoint: int, data: bytes, timeout_s: float) -> int:
        if self._link is None:
            raise LinkError("the Helios is not open")
        with guard_port("the Helios"):
            written_bytes: int = self._link.write(endpoint, data, timeout_ms(timeout_s))
            return written_bytes

    def _read_answer(self, timeout_s: float = ANSWER_TIMEOUT_S) -> bytes:
        """Return one answer. Raise USBTimeoutError without an answer, LinkError if the link fails."""
        try:
            return bytes(self._link.read(ANSWER_ENDPOINT, ANSWER_BYTES, timeout_ms(timeout_s)))
        except usb.core.USBTimeoutError:
            raise
        except Exception as error:
            raise build_lost_error("the Helios", error) from None

    def _query(self, command: int, min_bytes: int) -> bytes:
        """Return the answer to a query without its first byte, which names the query. Raise LinkError without one."""
        for _ in range(QUERY_TRIES):
            self._command(command, 0)
            for _ in range(ANSWER_TRIES):
                with suppress(usb.core.USBTimeoutError):
                    answer = self._read_answer()
                    if answer[:1] == bytes([0x80 | command]) and len(answer) > min_bytes:
                        return answer[1:]
        raise LinkError(f"the Helios does not answer query {command}: unplug it and plug it in again")

    def _drain(self) -> None:
        """Discard answers to earlier queries."""
        with suppress(usb.core.USBTimeoutError):
            for _ in range(DRAIN_READS_MAX):
                self._read_answer(DRAIN_TIMEOUT_S)
