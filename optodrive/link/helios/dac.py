"""A Helios laser DAC over pyusb: version, name, status, shutter, stop, frames.

Its command that erases the firmware is not here, and never shall be. It has no interlock and no time-out for a silent
host: see docs/how-to/use-a-helios-dac.md for what that means.
"""

from contextlib import suppress
from types import TracebackType
from typing import Any, Self

import usb.core
import usb.util

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, LocalProtocolError
from optodrive.device.config import BoardSection
from optodrive.link.helios.frames import HOST_LOSS_EMISSION_MAX_S, HeliosFrame
from optodrive.link.transport.usb_device import build_lost_error, build_open_error, find_device, timeout_ms

VENDOR_ID, PRODUCT_ID = 0x1209, 0xE500
INTERFACE, ALTERNATE_SETTING = 0, 1
COMMAND_ENDPOINT, ANSWER_ENDPOINT, FRAME_ENDPOINT = 0x06, 0x83, 0x02
ANSWER_BYTES = 32
STOP, SHUTTER, STATUS, VERSION, NAME, HOST_VERSION = 1, 2, 3, 4, 5, 7
PROTOCOL_VERSION = 11
"""The protocol this driver speaks, as the maker's own host software numbers it."""
READY = b"\x83\x01"
ENABLE_DELAY_S = 0.1
STOP_DELAY_S = 0.11
"""The board drops frames for 100 ms after a stop."""
COMMAND_TIMEOUT_S = ANSWER_TIMEOUT_S = 0.032
DRAIN_TIMEOUT_S = 0.005
DRAIN_READS_MAX = 16
QUERY_TRIES, ANSWER_TRIES = 2, 3
"""A question is asked so often, and its answer waited for so often."""
STOP_TRIES = 3
FRAME_TIMEOUT_S = 0.1
"""More than the USB needs for the longest frame."""


class Helios:
    """One board. Once open it is dark; closed, or left by whatever way, it was stopped and its shutter closed.

    backend: pyusb's, None for libusb.
    """

    def __init__(self, board: BoardSection, clock: Clock, backend: Any = None) -> None:
        self.board = board
        self.version = 0
        self.name = "Helios"
        self._clock = clock
        self._backend = backend
        self._device: Any = None
        self._answer_pending = False

    def __enter__(self) -> Self:
        """Open it."""
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop it, close its shutter, give it back; an error on the way here is not covered by one of closing."""
        if error is None:
            self.close()
        else:
            with suppress(LinkError):
                self.close()

    def open(self) -> None:
        """Claim it, ask who it is, make it dark; InputError where it is not the configured one, else LinkError."""
        self._device = find_device(VENDOR_ID, PRODUCT_ID, backend=self._backend)
        try:
            self._identify()
        except usb.core.USBError as error:
            self._release()
            raise build_open_error("the Helios", error) from None
        except BaseException:
            self._release()
            raise

    def _identify(self) -> None:
        usb.util.claim_interface(self._device, INTERFACE)
        self._device.set_interface_altsetting(INTERFACE, ALTERNATE_SETTING)
        self._clock.sleep(ENABLE_DELAY_S)
        self._drain()
        self.version = int.from_bytes(self._query(VERSION, 4)[:4], "little")
        self._command(HOST_VERSION, PROTOCOL_VERSION)
        self.name = self._query(NAME, 1).split(b"\0")[0].decode("ascii", "replace")
        if self.board.uid and self.board.uid != self.name:
            raise InputError("board.uid", self.name, f"{self.board.uid}, the Helios configured", "board")
        self.stop()

    def close(self) -> None:
        """Stop it, close its shutter, give it back; LinkError where it could not be told. Does nothing when closed."""
        if self._device is None:
            return
        try:
            self.stop()
        finally:
            self._release()

    def _release(self) -> None:
        device, self._device = self._device, None
        with suppress(usb.core.USBError):  # an alternate setting without endpoints stops it as well
            device.set_interface_altsetting(INTERFACE, 0)
        with suppress(usb.core.USBError):
            usb.util.dispose_resources(device)

    # --- commands -----------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Stop, shutter closed, and the stop's time waited for; LinkError where it could not be told either of them."""
        failures = [self._command_with_retries(STOP, 0), self._command_with_retries(SHUTTER, 0)]
        for failure in failures:
            if failure is not None:
                bound = f"it plays at most {HOST_LOSS_EMISSION_MAX_S * 1e3:g} ms more"
                raise LinkError(f"the Helios may not have heard to stop and close its shutter, {bound}: {failure}")
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

    def open_shutter(self) -> None:
        """Open the shutter; InputError unless the configuration says that an interlock watches."""
        self.require_interlock()
        self._command(SHUTTER, 1)

    def is_ready(self) -> bool:
        """Whether it takes another frame; no answer, and any but the one that says so, is no."""
        if self._answer_pending:
            self._drain()
        self._command(STATUS, 0)
        try:
            answer = self._read_answer()
        except usb.core.USBTimeoutError:
            answer = b""
        self._answer_pending = answer not in (READY, b"\x83\x00")
        return answer == READY

    def send(self, frame: HeliosFrame) -> None:
        """Send one frame, which must only be done when it is ready; InputError unless an interlock watches.

        LocalProtocolError for a frame that could leave the light on, LinkError where it is not taken whole.
        """
        self.require_interlock()
        HeliosFrame.from_bytes(frame.data)
        written_bytes = self._write(FRAME_ENDPOINT, frame.data, FRAME_TIMEOUT_S)
        if written_bytes != len(frame.data):
            raise LinkError(f"link to the Helios lost: it took {written_bytes} of a frame's {len(frame.data)} bytes")

    def require_interlock(self) -> None:
        """Raise InputError unless the configuration says that an external interlock watches."""
        if self.board.transport != "helios" or not self.board.interlock_watched:
            raise InputError(
                "board.interlock_watched",
                self.board.interlock_watched,
                'true, with transport "helios": it has no interlock of its own, say so once another cuts the laser',
            )

    # --- transfers ----------------------------------------------------------------------------------------------

    def _command(self, command: int, value: int) -> None:
        if command not in (STOP, SHUTTER, STATUS, VERSION, NAME, HOST_VERSION):
            raise LocalProtocolError(f"command {command:#04x} is none that this driver sends")
        if self._write(COMMAND_ENDPOINT, bytes([command, value]), COMMAND_TIMEOUT_S) != 2:
            raise LinkError("link to the Helios lost: it took half a command")

    def _write(self, endpoint: int, data: bytes, timeout_s: float) -> int:
        if self._device is None:
            raise LinkError("the Helios is not open")
        try:
            written_bytes: int = self._device.write(endpoint, data, timeout_ms(timeout_s))
        except usb.core.USBError as error:
            raise build_lost_error("the Helios", error) from None
        return written_bytes

    def _read_answer(self, timeout_s: float = ANSWER_TIMEOUT_S) -> bytes:
        """One answer; USBTimeoutError without one, LinkError where the link fails."""
        try:
            return bytes(self._device.read(ANSWER_ENDPOINT, ANSWER_BYTES, timeout_ms(timeout_s)))
        except usb.core.USBTimeoutError:
            raise
        except usb.core.USBError as error:
            raise build_lost_error("the Helios", error) from None

    def _query(self, command: int, min_bytes: int) -> bytes:
        """What it answers to a question, less the first byte, which must name it; LinkError without an answer."""
        for _ in range(QUERY_TRIES):
            self._command(command, 0)
            for _ in range(ANSWER_TRIES):
                with suppress(usb.core.USBTimeoutError):
                    answer = self._read_answer()
                    if answer[:1] == bytes([0x80 | command]) and len(answer) > min_bytes:
                        return answer[1:]
        raise LinkError(f"the Helios does not answer question {command}: unplug it and plug it in again")

    def _drain(self) -> None:
        """Forget answers to questions that nobody waits for any more."""
        with suppress(usb.core.USBTimeoutError):
            for _ in range(DRAIN_READS_MAX):
                self._read_answer(DRAIN_TIMEOUT_S)
