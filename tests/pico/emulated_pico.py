"""The firmware's image for the Raspberry Pi Pico, run by rp2040js: the very UF2, with other settings if asked for.

The interface is that of `EmulatedChip`. The image writes no log: a witness beside the emulator makes one of the pins,
of the SPI words and of what the core's functions are called with. Mirrors are those that the DAC was told, or the
decoded frames of XY2-100.
"""

import json
import os
import re
import struct
import subprocess
import sys
import tempfile
import weakref
from collections import deque
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from firmware_ports import require
from optodrive.link.protocol import messages as m
from optodrive.link.simulator.guards import INTERFACES, BoardSettings
from optodrive.link.simulator.measured_mirrors import MIRROR_FAULTS

HERE = Path(__file__).parent
PORT = HERE.parents[1] / "firmware_protocol" / "ports" / "rp2040"
CORE, EMULATION = PORT.parents[1] / "core", PORT.parents[1] / "emulator"
MODULES = Path(sys.prefix).parent / ".node"
EMULATOR = MODULES / "node_modules" / "rp2040js" / "dist" / "esm" / "index.js"
SETTINGS = struct.Struct("<3H2x3I8H12sI4H?BH")
"""struct board_config of the port."""
FIRMWARE = 0x0001_0000
BLOCK = struct.Struct("<8I476sI")
FLASH = 0x1000_0000
OFFSETS = ("now_us", "state", "fault", "index", "x", "y", "duty", "crc_errors", "format_errors")
SYMBOLS = (
    "board",
    "change_state",
    "outputs_set_gate",
    "xy2_100_move",
    "host_serve",
    "SETTINGS",
    "data_begin",
    "data_stored",
    "bss_end",
)
INPUT_PINS = {"interlock": 10, "key": 9, "estop": 8}
HOST_CLOSED, TRIGGER = 2, 20
STATUS_OK = 0xFDFD
"""Of a scan head: power, temperature and positions in order."""
PULSE_US = 2
PWM_STEPS, DUTY_FULL = 2500, 65535
BY_POINT, BY_RESET = -1, -2
LATE_TICK_US = 700
LOOP_US = 300
"""The port's main loop turns within this time."""


def encode_status(word):
    """Return the frame of a scan head's status: control bits 001, 16 bits, even parity."""
    bits = 1 << 17 | word << 1
    return bits | bits.bit_count() % 2


ANSWERS = {
    "silence_head": {"frame": None, "line": False},
    "fail_head": {"frame": encode_status(STATUS_OK & 0x7F7F)},
    "repair": {"frame": encode_status(STATUS_OK)},
}


def require_emulator():
    """Raise AssertionError with the way to install the emulator."""
    require("arm-none-eabi-gcc", "make", "node")
    assert EMULATOR.exists(), f"the RP2040's tests need: npm install --prefix {MODULES} --no-save rp2040js@1.4.1"


def read_symbols(elf):
    """Return the addresses of an image's symbols by name."""
    listed = subprocess.run(["arm-none-eabi-nm", elf], capture_output=True, text=True, check=True).stdout
    return {name: int(address, 16) for address, _, name in map(str.split, listed.splitlines())}


def read_offsets(folder):
    """Return where the port's compiler places what the witness reads of struct board."""
    sizes = re.search(r"SIZES := (.*)", (PORT / "Makefile").read_text())[1].split()
    built, raw = folder / "offsets.o", folder / "offsets.bin"
    flags = ["-mcpu=cortex-m0plus", "-mthumb", "-ffreestanding", f"-I{CORE}", *sizes]
    subprocess.run(["arm-none-eabi-gcc", *flags, "-c", HERE / "offsets.c", "-o", built], check=True)
    subprocess.run(["arm-none-eabi-objcopy", "-O", "binary", "-j", ".offsets", built, raw], check=True)
    return dict(zip(OFFSETS, (value for (value,) in struct.iter_unpack("<I", raw.read_bytes())), strict=True))


def read_uf2(path):
    """Return the bytes that a UF2 file puts into the flash, from its first address on."""
    blocks = [BLOCK.unpack_from(path.read_bytes(), at) for at in range(0, path.stat().st_size, BLOCK.size)]
    assert [block[3] for block in blocks] == [FLASH + block[4] * k for k, block in enumerate(blocks)]
    return b"".join(block[8][: block[4]] for block in blocks)


class PicoImage:
    """The port as `make` builds it in a folder.

    mutant: number of the disabled guard
    port: folder of the sources
    """

    def __init__(self, folder, mutant=0, port=PORT):
        require_emulator()
        build = ["make", "-s", "-C", port, f"BUILD={folder}", f"MUTANT={mutant}"]
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
        self.flash = read_uf2(folder / "board.uf2")
        self.symbols = {name: read_symbols(folder / "board.elf")[name] for name in SYMBOLS}
        self.offsets = read_offsets(folder)

    def with_settings(self, settings):
        """Return the flash's bytes with the settings of a board, as an edited settings.h places them."""
        symbols = self.symbols
        at = symbols["data_stored"] + symbols["SETTINGS"] - symbols["data_begin"] - FLASH
        limits = vars(settings.limits).values()
        uid = bytes.fromhex(settings.uid)
        sizes = settings.cell_codes, settings.queue_points, settings.cells, settings.window_pulses
        mirrors = INTERFACES.index(settings.interface), settings.feedback_codes
        packed = SETTINGS.pack(*limits, uid, FIRMWARE, *sizes, settings.key_edge, *mirrors)
        return self.flash[:at] + packed + self.flash[at + len(packed) :]


class EmulatedPico:
    """A Pico with its circuit. settings: None for those of the image. sink: receives each log event."""

    lease_until_us = 0
    FAULTS = ("stop_loop", "stop_tick", "late_tick", "stick_gate", *ANSWERS, *MIRROR_FAULTS)

    def __init__(self, image, settings, sink, seed=None):
        self._sink, self._now_us, self.chip_us = sink, 0, 0.0
        self._output, self._frame = deque(), b""
        self._emission = None
        self.state, self.gate, self.inputs = "BOOT", False, {"interlock": True, "key": True, "estop": False}
        self.pins, self.mirrors, self.dac = [], [], []
        self._triggers = 0
        self.nominal_us = []
        """Times at which the core commanded the edges of `pins`."""
        self.ticks_us = (0.0, 0.0)
        self.stack_bytes = (0, 0)
        self.frames, self.frame_errors, self.moves_us = 0, [], []
        flash = image.with_settings(settings) if settings else image.flash
        setup = {"emulator": str(EMULATOR), "image": flash.hex(), "symbols": image.symbols, "offsets": image.offsets}
        setup |= {"seed": int.from_bytes(os.urandom(4)) if seed is None else seed + 1, "lateNanos": LATE_TICK_US * 1000}
        with tempfile.NamedTemporaryFile("w", suffix=".json", delete=False) as file:
            json.dump(setup, file)
        self._process = subprocess.Popen(
            ["node", EMULATION / "bench.mjs", file.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self.close = weakref.finalize(self, _end, self._process, file.name)
        self._command("pin", HOST_CLOSED, True)
        for name, value in self.inputs.items():
            self._command("pin", INPUT_PINS[name], value != (name == "estop"))

    # --- backend of a board -------------------------------------------------------------------------------------

    def advance(self, now_us):
        """Let the chip run until a time."""
        self._now_us = now_us
        if self.chip_us < now_us:
            self._command("run", now_us)

    def receive(self, data, now_us):
        """Send bytes of the host, which need their time on the line."""
        self.advance(now_us)
        if data:
            self._command("bytes", data.hex())

    def bytes_to_send(self):
        """Return the bytes for the host that have arrived by now."""
        data = b""
        while self._output and self._output[0][0] <= self._now_us:
            data += self._output.popleft()[1]
        return data

    def open_port(self, now_us):
        """Let a host open the adapter's port: DTR# goes low."""
        self.advance(now_us)
        self._command("pin", HOST_CLOSED, False)
        self._command("run", self.chip_us + LOOP_US)

    def on_link_lost(self, now_us):
        """Close the adapter's port: DTR# goes high."""
        self.advance(now_us)
        self._command("pin", HOST_CLOSED, True)
        self._command("run", self.chip_us + LOOP_US)

    def set_input(self, name, value, now_us):
        """Change the level of an input's pin, and let the next tick read it."""
        self.advance(now_us)
        self.inputs[name] = value
        self._sink({"t_us": round(self.chip_us), "event": "input", "input": name, "value": value})
        self._command("pin", INPUT_PINS[name], value != (name == "estop"))
        self._command("run", self.chip_us + LOOP_US)

    def receive_trigger(self, now_us):
        """Give the trigger input a pulse of PULSE_US."""
        self.advance(now_us)
        self._triggers += 1
        self._sink({"t_us": int(self.chip_us), "event": "trigger", "count": self._triggers})
        self._command("pin", TRIGGER, True)
        self._command("run", self.chip_us + PULSE_US)
        self._command("pin", TRIGGER, False)

    def reset(self, now_us):
        """Pull the pin RUN low for a moment."""
        self.advance(now_us)
        self._command("reset")
        self._output.clear()

    def send_break(self, now_us):
        """Send a BREAK on the line."""
        self.advance(now_us)
        self._command("break")

    def next_event_us(self):
        """Return None: the chip has its own time."""
        return

    def inject_fault(self, name):
        """Break a part of the board, its scan head or a mirror, or repair that: one of FAULTS."""
        if name in ANSWERS:
            self.answer(**ANSWERS[name])
        if name in MIRROR_FAULTS or name == "repair":
            self._command("mirror", name)
        if name in (*ANSWERS, *MIRROR_FAULTS):
            return
        self._command("inject", name)

    def measure_ticks(self):
        """Return the longest tick and the longest time between two since the last call, µs."""
        self._command("ticks")
        return self.ticks_us

    def play_every_frame(self):
        """From now on, play also a frame of XY2-100 that is as the last one, in place of counting it."""
        self._command("everyFrame")

    def count_frames(self):
        """Return the number of XY2-100 frames since power-up or reset; what is wrong with any is in `frame_errors`."""
        self._command("frames")
        return self.frames

    def answer(self, **answer):
        """Let the scan head answer otherwise: frame, line, bad of xy2_100.mjs."""
        self._command("head", answer)

    def measure_stack(self):
        """Return the bytes of the stack that were used since power-up, and those that there are."""
        self._command("stack")
        return self.stack_bytes

    # --- the emulator -------------------------------------------------------------------------------------------

    def _command(self, *values):
        self._process.stdin.write(json.dumps(values).encode() + b"\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the emulator has ended")
        for name, *fields in json.loads(line):
            getattr(self, f"_on_{name}")(*fields)

    def _on_done(self, now_us):
        self.chip_us = now_us

    def _on_byte(self, at_us, byte):
        self._frame += bytes([byte])
        if byte == 0:
            self._output.append((at_us, self._frame))
            self._frame = b""

    def _on_usb(self, at_us, data):
        raise AssertionError(f"{data} on USB at {at_us} µs, while the UART holds the board")

    def _on_control(self, at_us, data):
        """Ignore the answer to a request of the USB computer."""

    def _on_pin(self, at_us, on, compare):
        self.gate = on
        self.pins.append((at_us, on, compare))

    def _on_mirrors(self, at_us, x, y):
        self.mirrors.append((at_us, x, y))

    def _on_move(self, at_us):
        self.moves_us.append(at_us)

    def _on_frame_error(self, at_us, what):
        self.frame_errors.append((at_us, what))

    def _on_frames(self, count, errors):
        assert errors == len(self.frame_errors)
        self.frames = count

    def _on_dac(self, at_us, command, value):
        self.dac.append((at_us, command, value))

    def _on_ticks(self, longest_us, apart_us):
        self.ticks_us = longest_us, apart_us

    def _on_stack(self, used, available):
        self.stack_bytes = used, available

    def _on_rx_error(self, at_us, count):
        self._sink({"t_us": round(at_us), "event": "rx_error", "bad_frames": count})

    def _on_reset(self, at_us, cause):
        self._frame = b""
        self.state = "BOOT"

    def _on_fault(self, at_us, fault):
        self._sink({"t_us": round(at_us), "event": "fault", "fault": m.FAULTS[fault]})

    def _on_state(self, at_us, state, before, reason):
        self.state = m.STATES[state]
        words = {"state": self.state, "before": m.STATES[before], "reason": m.EVENT_REASONS[reason]}
        self._sink({"t_us": round(at_us), "event": "state", **words})

    def _on_gate(self, at_us, on, index, reason, x, y, duty):
        """Log an edge, and the pulse that it ends, at the place that the DAC was told before it began."""
        at_us = round(at_us)
        if on:
            self._emission = at_us, index, *self.mirrors[-1][1:], duty
        if self._emission[-1] * PWM_STEPS // DUTY_FULL:  # else no step of the PWM, so no edge
            self.nominal_us.append(at_us)
        if on:
            self._sink({"t_us": at_us, "event": "gate", "on": True, "reason": f"point {index}"})
            return
        point = f"point {index} done" if reason == BY_POINT else "reset"
        self._sink(
            {"t_us": at_us, "event": "gate", "on": False, "reason": m.EVENT_REASONS[reason] if reason >= 0 else point}
        )
        on_us, index, x, y, duty = self._emission
        if reason != BY_RESET:
            pulse = {"index": index, "x": x, "y": y, "duty": duty, "on_us": on_us, "off_us": at_us}
            self._sink({"t_us": at_us, "event": "pulse", **pulse})


class EmulatedDigitalPico(EmulatedPico):
    """A Pico with a digital scan head, by XY2-100."""

    def __init__(self, image, settings, sink, seed=None):
        super().__init__(image, replace(settings or BoardSettings(), interface="xy2-100"), sink, seed)


def _end(process, path):
    process.kill()
    with suppress(BrokenPipeError):
        process.communicate()
    Path(path).unlink()
