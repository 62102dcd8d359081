"""The journal of a sweep: one line of CSV per executed pulse, written while the sweep runs.

A line is one write, so a process that is killed leaves all earlier lines; a line without its end is dropped on reading.
"""

import os
import threading
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple, Self

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Run
from optodrive.lab.calibration.pixels.sweep import Aim

PRE_PULSE_S = 0.02
"""Time from the start of a run to its pulse, as `calibrate pixels` asks for."""


class SweepPulse(NamedTuple):
    """An executed pulse.

    start_unix_s: gate on, by the host's clock
    start_board_s: by the board's
    """

    aim: str
    pixel: int
    start_unix_s: float
    start_board_s: float
    width_s: float
    power_w: float


HEADER = ",".join(SweepPulse._fields)


class SweepJournal:
    """The journal of one display in a file.

    Its own thread writes it, because a disk may take longer than a lease.
    """

    def __init__(self, path: Path, pulses: list[SweepPulse], file: int) -> None:
        self.path, self.pulses = path, pulses
        self._file = file
        self._error: OSError | None = None
        self._lines: SimpleQueue[str | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="sweep journal", daemon=True)
        self._thread.start()

    @classmethod
    def open(cls, path: Path, display: str) -> Self:
        """Open the journal of a display, or create it. Raise InputError for another display's or another file."""
        head = f"# optodrive sweep of {display}\n{HEADER}\n"
        try:
            text = path.read_text(encoding="utf-8") if path.exists() else ""
            complete = text[: text.rfind("\n") + 1] or head
            if not complete.startswith(head):
                raise InputError(str(path), complete.splitlines()[0], f"{head.splitlines()[0]!r}, and {HEADER}")
            pulses = [_parse_line(path, number, line) for number, line in enumerate(complete.splitlines()[2:], 3)]
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.ftruncate(file, len(complete.encode()) if text else 0)
            if not text:
                os.write(file, head.encode())
        except OSError as error:
            raise InputError(str(path), error.strerror, "a file that can be written") from None
        return cls(path, pulses, file)

    def list_done(self, aim: str) -> frozenset[int]:
        """Return the pixels whose pulse at an aim was executed."""
        return frozenset(pulse.pixel for pulse in self.pulses if pulse.aim == aim)

    def append(self, pulses: list[SweepPulse]) -> None:
        """Append pulses without waiting for the disk. Raise InputError if an earlier write failed."""
        self.raise_if_failed()
        self.pulses += pulses
        self._lines.put("".join(",".join(map(str, pulse)) + "\n" for pulse in pulses))

    def raise_if_failed(self) -> None:
        """Raise InputError if a write failed."""
        if self._error is not None:
            raise InputError(str(self.path), self._error.strerror, "a file that can be written")

    def close(self) -> None:
        """Write the remaining lines and close the file."""
        self._lines.put(None)
        self._thread.join()
        os.close(self._file)

    def _write(self) -> None:
        while (lines := self._lines.get()) is not None:
            try:
                os.write(self._file, lines.encode())
                os.fdatasync(self._file)
            except OSError as error:
                self._error = error
                return


def _parse_line(path: Path, number: int, line: str) -> SweepPulse:
    try:
        aim, pixel, *numbers = line.split(",")
        start_unix_s, start_board_s, width_s, power_w = map(float, numbers)
        return SweepPulse(aim, int(pixel), start_unix_s, start_board_s, width_s, power_w)
    except ValueError:
        raise InputError(f"{path}, line {number}", line[:80], HEADER) from None


def build_runs(pulses: list[SweepPulse], aims: list[Aim], display: str, ambient_k: float) -> Measurement:
    """Build one run per pixel and aim, with its pulse at PRE_PULSE_S, to be merged with measured signals."""
    offsets = {aim.name: aim for aim in aims}
    return Measurement(
        tuple(
            Run(
                f"{pulse.aim}-{pulse.pixel:04d}",
                ambient_k,
                np.array([[PRE_PULSE_S, pulse.width_s, pulse.power_w, float(pulse.pixel)]]),
                {},
                {
                    "aim_x_m": offsets[pulse.aim].x_m,
                    "aim_y_m": offsets[pulse.aim].y_m,
                    "display": display,
                    "started_unix_s": pulse.start_unix_s - PRE_PULSE_S,
                },
            )
            for pulse in pulses
        )
    )
