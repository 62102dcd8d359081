"""A Pico's image in an emulator of its chip, rp2040js, as a process with a pty in place of its USB port.

The chip is slower than the computer. Its time is that of its instructions, at most RATE of the computer's. It stands
in a file, from which a preloaded library (firmware_protocol/emulator/board_time.c) gives it to the programs that use
the port: both are late together. The time is written before what the chip has sent by then is passed on, so that no
report is from a tick to come.
"""

import json
import mmap
import os
import select
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from optodrive.core.child_process import die_with_parent
from optodrive.core.errors import InputError, LinkError, Unquoted
from optodrive.link.boot_loader import BLOCK, Image
from optodrive.link.simulator.pseudo_terminal import check_link_path, open_pty, remove_link

PACKAGE, VERSION = "rp2040js", "1.4.1"
TOOLS = {"node": "nodejs npm", "cc": "gcc libc6-dev"}
"""Debian's packages of the programs that are needed."""
RATE = 0.1
"""A host that is stalled for a second has lost 0.1 s, its lease."""
STEP_US = 500
TURNED_US = 50_000
"""Time at which the key is turned, after power-up."""
BEGIN_NS = 1_000_000_000_000
"""Of the host's clock: a computer that has been on for a while."""
READ_MAX = 4096
HOST_CLOSED, KEY = 2, 9
SAFE_PINS = {HOST_CLOSED: True, 10: True, KEY: False, 8: True}
"""Levels at power-up: no adapter, interlock closed, key off, emergency stop released."""

LogSink = Callable[[dict[str, Any]], None]
"""Receives each edge of the gate and each move of the mirrors."""


def find_modules(folder: Path) -> Path:
    """Return the emulator's main module in a folder of npm. Raise InputError, naming the package, if one is missing."""
    missing = [packages for tool, packages in TOOLS.items() if shutil.which(tool) is None]
    if missing:
        raise InputError("PATH", Unquoted("no emulator"), f"Debian's {' '.join(missing)}")
    package = folder / "node_modules" / PACKAGE
    try:
        version = json.loads((package / "package.json").read_text())["version"]
    except (OSError, ValueError, KeyError, TypeError):
        version = "none"
    if version != VERSION:
        found, expected = Unquoted(f"{PACKAGE} {version}"), f"npm install --prefix {folder} {PACKAGE}@{VERSION}"
        raise InputError("--modules", found, expected)
    return package / "dist" / "esm" / "index.js"


def build_clock(source: Path, library: Path) -> None:
    """Build the library that gives a program the chip's time. Raise LinkError if it fails."""
    command = ["cc", "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode:
        reason = next(iter(built.stderr.strip().splitlines()), "no reason")
        raise LinkError(f"cc ended with {built.returncode}: {reason}")


class EmulatedPico:
    """The process of one image.

    port: link to the pty; beside it stand the chip's time and the library that gives it to a program
    """

    def __init__(self, image: Image, firmware: Path, emulator: Path, port: Path, on_event: LogSink) -> None:
        """Raise InputError for another chip's image or a link that cannot be created."""
        if image.chip != "RP2040":
            raise InputError(str(image.path), Unquoted(f"an image for the {image.chip}"), "one for the RP2040")
        check_link_path("--port", port)
        self.port, self.time_file, self.library = port, Path(f"{port}.time"), Path(f"{port}.so")
        self._on_event, self._output = on_event, b""
        self._now_us, self._is_open, self._stopping = 0, False, False
        build_clock(firmware / "emulator" / "board_time.c", self.library)
        self.time_file.write_bytes(struct.pack("<Q", BEGIN_NS))
        with self.time_file.open("r+b") as file:
            self._time = mmap.mmap(file.fileno(), 8)
        with tempfile.NamedTemporaryFile("w", suffix=".json") as setup:
            json.dump({"emulator": str(emulator), "image": read_flash(image).hex(), "seed": 1}, setup)
            setup.flush()
            self._process = subprocess.Popen(
                [shutil.which("node") or "node", firmware / "emulator" / "bench.mjs", setup.name],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                preexec_fn=die_with_parent,
            )
            for pin, high in SAFE_PINS.items():
                self._command("pin", pin, high)
        self._command("usb", "plug")
        self._terminal = open_pty(port)
        self._terminal_path = port.readlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        remove_link(self.port, self._terminal_path)
        for path in (self.time_file, self.library):
            path.unlink(missing_ok=True)

    def stop(self) -> None:
        """End after this step."""
        self._stopping = True

    def run(self) -> None:
        """Run until stop(). Raise LinkError if the emulator ends by itself."""
        next_s = time.monotonic()
        while not self._stopping:
            self._follow_port()
            self._now_us += STEP_US
            self._command("run", self._now_us)
            if self._now_us == TURNED_US:
                self._command("pin", KEY, True)
            self._time[:] = struct.pack("<Q", BEGIN_NS + 1000 * self._now_us)
            self._pass_on()
            time.sleep(max(0.0, next_s - time.monotonic()))
            next_s = time.monotonic() + STEP_US * 1e-6 / RATE  # lost time is not caught up: the host's is lost too

    def _follow_port(self) -> None:
        poll = select.poll()
        poll.register(self._terminal, select.POLLIN)
        events = dict(poll.poll(0)).get(self._terminal, 0)
        is_open = not events & select.POLLHUP
        if is_open != self._is_open:
            self._is_open = is_open
            self._command("usb", "open" if is_open else "close")
        if events & select.POLLIN:
            self._command("usb", "bytes", os.read(self._terminal, READ_MAX).hex())

    def _pass_on(self) -> None:
        data, self._output = self._output, b""
        if data and self._is_open:
            with suppress(BlockingIOError):  # a host that does not read misses frames
                os.write(self._terminal, data)

    def _command(self, *values: object) -> None:
        """Give the emulator a command, and take the records that it leaves."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None  # noqa: S101
        assert stdout is not None  # noqa: S101
        line = b""
        with suppress(BrokenPipeError):
            stdin.write(json.dumps(values).encode() + b"\n")
            stdin.flush()
            line = stdout.readline()
        if not line:
            raise LinkError("the emulator has ended")
        for name, at_us, *fields in json.loads(line):
            if name == "usb":
                self._output += bytes.fromhex(fields[0])
            elif name == "pin":
                self._on_event({"event": "gate", "t_us": round(at_us), "on": fields[0], "compare": fields[1]})
            elif name == "mirrors":
                self._on_event({"event": "mirrors", "t_us": round(at_us), "x": fields[0], "y": fields[1]})


def read_flash(image: Image) -> bytes:
    """Return the bytes that an image puts into the flash, from its first address on."""
    blocks = (BLOCK.unpack_from(image.content, at) for at in range(0, len(image.content), BLOCK.size))
    return b"".join(block[8][: block[4]] for block in blocks)
