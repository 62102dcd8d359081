"""The Pico's image as a process on a pty, in place of its USB port, for a host that lives in the chip's time.

python tests/pico/board.py --build FOLDER --pty LINK --log FILE --time FILE

The image, built in FOLDER, is the one that a person flashes, with its own settings. The chip's time is that of its
instructions, at most RATE of the computer's; the process writes it to --time, from which board_time.c gives it to the
host. It is written before what the chip has sent by then is passed on, so that no report is from a tick to come.
"""

import argparse
import json
import mmap
import os
import select
import signal
import struct
import sys
import time
from contextlib import suppress
from pathlib import Path

sys.path += [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from emulated_pico import PicoImage
from emulated_usb_pico import EmulatedUsbPico

from optodrive.link.simulator.pseudo_terminal import open_pty

RATE = 0.1
"""A host that is stalled for a second has lost 0.1 s, its lease."""
STEP_US = 500
TURNED_US = 50_000
"""Time at which the key is turned, after power-up."""
BEGIN_NS = 1_000_000_000_000
"""Of the host's clock: a computer that has been on for a while."""
READ_MAX = 4096


class PicoProcess:
    """A Pico whose USB port is a pty."""

    def __init__(self, options):
        self._log = options.log.open("w", buffering=1)
        with options.time.open("r+b") as file:
            self._time = mmap.mmap(file.fileno(), 8)
        image = PicoImage(options.build)
        image.flash = image.flash.replace(b"rp2040-00001", b"simulated001")  # it heats nothing
        self._pico = EmulatedUsbPico(image, None, self._write_log)
        self._now_us, self._is_open, self._stopping = 0, False, False
        self._next_s = time.monotonic()
        self._terminal = open_pty(options.pty)

    def stop(self, *_):
        """End after this step."""
        self._stopping = True

    def run(self):
        """Run until stop()."""
        self._pico.set_input("key", False, 0)
        while not self._stopping:
            self._step()
        self._pico.close()

    def _step(self):
        self._follow_port()
        self._now_us += STEP_US
        self._pico.advance(self._now_us)
        if self._now_us == TURNED_US:
            self._pico.set_input("key", True, self._now_us)
        self._time[:] = struct.pack("<Q", BEGIN_NS + 1000 * self._now_us)
        self._pass_on(self._pico.bytes_to_send())
        time.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = time.monotonic() + STEP_US * 1e-6 / RATE  # lost time is not caught up: the host's is lost too

    def _follow_port(self):
        poll = select.poll()
        poll.register(self._terminal, select.POLLIN)
        events = dict(poll.poll(0)).get(self._terminal, 0)
        is_open = not events & select.POLLHUP
        if is_open != self._is_open:
            self._is_open = is_open
            self._write_log({"t_us": self._now_us, "event": "port", "open": is_open})
            (self._pico.open_port if is_open else self._pico.on_link_lost)(self._now_us)
        if events & select.POLLIN:
            self._pico.receive(os.read(self._terminal, READ_MAX), self._now_us)

    def _pass_on(self, data):
        if data and self._is_open:
            with suppress(BlockingIOError):  # a host that does not read misses frames
                os.write(self._terminal, data)

    def _write_log(self, event):
        self._log.write(json.dumps(event) + "\n")


def main():
    """Run the process."""
    parser = argparse.ArgumentParser()
    for name in ("--build", "--pty", "--log", "--time"):
        parser.add_argument(name, type=Path, required=True)
    process = PicoProcess(parser.parse_args())
    signal.signal(signal.SIGTERM, process.stop)
    process.run()


if __name__ == "__main__":
    main()
