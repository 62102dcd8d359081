"""The emulated Pico with its host on its own USB port. `usb.mjs` is the computer there."""

from emulated_pico import LOOP_US, EmulatedPico

SEND_BREAK = bytes.fromhex("2123ffff00000000")


class EmulatedUsbPico(EmulatedPico):
    """A Pico whose host is on its own USB port; the adapter's port stays closed."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.answers = []
        """To control requests: bytes, or None for one that was refused."""
        self.usb("plug")

    def usb(self, action, *values):
        """Let the computer at the USB port do something: a method of `UsbHost`."""
        self._command("usb", action, *values)

    def request(self, setup, data=b""):
        """Send a control request. Return its answer, None if it is refused."""
        self.answers.clear()
        self.usb("control", setup.hex(), data.hex())
        self._command("run", self.chip_us + 10 * LOOP_US)
        return None if None in self.answers else b"".join(self.answers)

    def receive(self, data, now_us):
        """Send bytes of the host, in packets."""
        self.advance(now_us)
        if data:
            self.usb("bytes", data.hex())

    def open_port(self, now_us):
        """Let a program open the port. It begins to read at the first whole frame."""
        self.advance(now_us)
        self._frame = None
        self.usb("open")
        self._command("run", self.chip_us + LOOP_US)

    def on_link_lost(self, now_us):
        """Let the program close the port."""
        self.advance(now_us)
        self.usb("close")
        self._command("run", self.chip_us + LOOP_US)

    def send_break(self, now_us):
        """Send a BREAK, which is a request."""
        self.advance(now_us)
        self.usb("control", SEND_BREAK.hex(), "")

    def _on_byte(self, at_us, byte):
        raise AssertionError(f"{byte} on the UART at {at_us} µs, while USB holds the board")

    def _on_usb(self, at_us, data):
        for byte in bytes.fromhex(data):
            if self._frame is not None:
                super()._on_byte(at_us, byte)
            elif byte == 0:
                self._frame = b""

    def _on_control(self, at_us, data):
        self.answers.append(bytes.fromhex(data))

    def _on_stall(self, at_us):
        self.answers.append(None)

    def _on_reset(self, at_us, cause):
        super()._on_reset(at_us, cause)
        self._frame = None
