"""Persistent budget state of a display between plays, because each play is a separate process."""

import os
import re
import time
from dataclasses import fields
from pathlib import Path
from typing import Any, Self
from zipfile import BadZipFile

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.files import atomic_write
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.limiter import shift_state

FORMAT = "optodrive-helios-memory"
VERSION = 5
REMOVE_WHEN_COLD = "remove it once the display has cooled"
BASES_S = {"zero_s": 0.0, "boot_s": 0.0}
RECENT = tuple(item.name for item in fields(BudgetState) if item.name.startswith("recent_"))
"""Columns whose length is not that of the display."""
ZERO_OFFSET_S = 1.0
"""Shift of a plan's zero when it is saved before emission, so that the stored state is never too cold."""


def read_boot() -> tuple[str, float]:
    """Return the identity of the computer's present run, and the Unix time of its start by the present clock, s."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    return boot, time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)


class HeatMemory:
    """File with the limiter's budget state after the last play on one laser DAC, in Unix time."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def for_device(cls, name: str) -> Self:
        """Return the memory of the DAC of this name, in the user's state folder."""
        folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "optodrive"
        return cls(folder / f"{re.sub('[^0-9A-Za-z]+', '-', name)}.npz")

    def save(self, budget: BudgetState, zero_s: float) -> None:
        """Save a budget state whose zero is Unix time zero_s. Raise InputError if the file cannot be written."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise InputError(str(self.path), error.strerror, "a file that can be written") from None
        columns = {item.name: getattr(budget, item.name) for item in fields(BudgetState)}
        boot, boot_s = read_boot()
        with atomic_write(self.path) as temporary, temporary.open("wb") as file:
            np.savez(file, format=FORMAT, version=VERSION, zero_s=zero_s, boot=boot, boot_s=boot_s, **columns)

    def load(self, now_s: float, cold: BudgetState) -> BudgetState:
        """Load the budget state with its zero at now_s, or return `cold` if nothing was saved.

        A positive at_s means that earlier pulses may still last for this time. Time is the computer's uptime where it
        has run since, so that nobody cools a display by setting the clock. Raise InputError if the file is unreadable,
        damaged, or belongs to another display or version.
        """
        if not self.path.exists():
            return cold
        try:
            with self.path.open("rb") as file, np.load(file) as table:
                arrays = {key: table[key] for key in table.files}
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            raise InputError(str(self.path), str(error), f"a file that can be read; {REMOVE_WHEN_COLD}") from None
        if (str(arrays.get("format")), str(arrays.get("version"))) != (FORMAT, str(VERSION)):
            raise InputError(f"{self.path}: version", arrays.get("version"), f"{FORMAT} {VERSION}; {REMOVE_WHEN_COLD}")
        if (pixels := np.asarray(arrays.get("rise_k")).size) != len(cold.rise_k):
            expected = f"{len(cold.rise_k)}, the configured display's; {REMOVE_WHEN_COLD}"
            raise InputError(f"{self.path}: pixels", pixels, expected)
        columns = {item.name: getattr(cold, item.name) for item in fields(BudgetState)}
        numbers = {name: self._read(arrays, name, like) for name, like in (columns | BASES_S).items()}
        zero_s, saved_boot_s = numbers.pop("zero_s"), numbers.pop("boot_s")
        boot, boot_s = read_boot()
        if str(arrays.get("boot")) == boot:
            now_s -= boot_s - saved_boot_s  # what the clock was set by
        if now_s < zero_s - ZERO_OFFSET_S:
            raise InputError(
                "the time of day", now_s, f"a time after the last play according to {self.path}; {REMOVE_WHEN_COLD}"
            )
        return shift_state(BudgetState(**numbers), zero_s - now_s)

    def _read(self, arrays: dict[str, Any], name: str, like: float | FloatArray | IntArray) -> Any:
        """Return numbers of the type and shape of another state's. Raise InputError: NaN passes every comparison."""
        stored, expected = np.asarray(arrays.get(name)), np.asarray(like)
        fits = stored.dtype == expected.dtype and stored.ndim == expected.ndim
        if not fits or (stored.shape != expected.shape and name not in RECENT) or np.isnan(stored).any():
            raise InputError(f"{self.path}: {name}", Unquoted("damage"), f"what a play has saved; {REMOVE_WHEN_COLD}")
        return float(stored) if stored.ndim == 0 else stored
