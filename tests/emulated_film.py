"""A multitouch film as a device file: a simulated film whose events come through a pseudo-terminal.

The process that opens it loads `emulated_evdev.c`, which answers the calls of the input layer by the kernel's header.
"""

import mmap
import os
import struct
import subprocess
import time
import tty
from itertools import chain
from pathlib import Path

from touch_film import TRACKING, SimulatedFilm, X, Y

SOURCE = Path(__file__).with_name("emulated_evdev.c")
SLOTS_MAX, BYTES = 16, 4 * (4 + 6 + 3 * 16)
EVENT = struct.Struct("@llHHi")


class FilmDevice:
    """A film at a path of its own. environment: of the processes that open it."""

    def __init__(self, folder, film=None, has_slots=True):
        library = folder / "emulated_evdev.so"
        subprocess.run(["cc", "-shared", "-fPIC", "-Wall", "-Werror", "-O1", "-o", library, SOURCE, "-ldl"], check=True)
        self.film, self.has_slots = film or SimulatedFilm(noise_m=0.0), has_slots
        state = folder / "film.state"
        state.write_bytes(bytes(BYTES))
        with state.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), BYTES)
        self._at_s = 0.0
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = Path(os.ttyname(self._slave))
        self.environment = {**os.environ, "LD_PRELOAD": str(library), "EMULATED_FILM": str(state)}
        self._write_state()

    def __enter__(self):
        return self

    def __exit__(self, *details):
        self.unplug()

    @property
    def clock(self):
        """Clock of the events' times that the reader has asked for."""
        return struct.unpack_from("@i", self._map, 4)[0]

    def _write_state(self):
        states = [[state[code] for state in self.film.states] for code in (TRACKING, X, Y)]
        padded = [values + [0] * (SLOTS_MAX - len(values)) for values in states]
        axes = [value for size in self.film.size for value in (0, size - 1, self.film.per_mm)]
        numbers = [int(self.has_slots), int(self.clock), self.film.slots, self.film.current, *axes, *chain(*padded)]
        self._map[:] = struct.pack(f"@{len(numbers)}i", *numbers)

    def touch(self, fingers, after_s=0.0, is_dropped=False, is_sent=True):
        """Move fingers, {key: (x_m, y_m)}.

        after_s: since the last events, at least; is_dropped: let the kernel drop all events of it but a fragment;
        is_sent: whether the events reach anybody, who would be there to read them
        """
        self.film.events.clear()
        self.film.report(0.0, fingers)
        self._write_state()
        events = [event[1:] for event in self.film.events]
        if is_dropped:
            events = [(0, 3, 0), *events[-2:]]
        self._at_s = max(self._at_s + after_s, time.clock_gettime(self.clock))
        seconds, rest_s = divmod(self._at_s, 1.0)
        data = b"".join(EVENT.pack(int(seconds), int(1e6 * rest_s), *event) for event in events)
        if is_sent:
            assert os.write(self._master, data) == len(data)

    def unplug(self):
        """Let the device vanish from its reader."""
        for name in ("_master", "_slave"):
            descriptor = getattr(self, name)
            if descriptor is not None:
                os.close(descriptor)
                setattr(self, name, None)
