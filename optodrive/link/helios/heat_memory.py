"""Persistent budget state of a display between plays, because each play is a separate process."""

import os
import re
from dataclasses import fields
from pathlib import Path
from typing import Any, Self
from zipfile import BadZipFile

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.files import atomic_write
from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.limiter import shift_state

FORMAT = "optodrive-helios-memory"
VERSION = 4
REMOVE_WHEN_COLD = "remove it once the display has cooled"
ZERO_OFFSET_S = 1.0
"""Shift of a plan's zero when it is saved before emission, so that the stored state is never too cold."""


class HeatMemory:
    """File with the limiter's budget state after the last play on one Helios, in Unix time."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def for_device(cls, name: str) -> Self:
        """Return the memory of the Helios of this name, in the user's state folder."""
        folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "optodrive"
        return cls(folder / f"{re.sub('[^0-9A-Za-z]+', '-', name)}.npz")

    def save(self, budget: BudgetState, zero_s: float) -> None:
        """Save a budget state whose zero is Unix time zero_s. Raise InputError if the file cannot be written."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise InputError(str(self.path), error.strerror, "a file that can be written") from None
        columns = {item.name: getattr(budget, item.name) for item in fields(BudgetState)}
        with atomic_write(self.path) as temporary, temporary.open("wb") as file:
            np.savez(file, format=FORMAT, version=VERSION, zero_s=zero_s, **columns)

    def load(self, now_s: float, cold: BudgetState) -> BudgetState:
        """Load the budget state with its zero at now_s, or return `cold` if nothing was saved.

        A positive at_s means that earlier pulses may still last for this time. Raise InputError if the file is
        unreadable or belongs to another display or version.
        """
        if not self.path.exists():
            return cold
        try:
            with self.path.open("rb") as file, np.load(file) as table:
                arrays = {key: table[key] for key in table.files}
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            raise InputError(str(self.path), str(error), f"a file that can be read; {REMOVE_WHEN_COLD}") from None
        if (str(arrays.get("format")), int(arrays.get("version", 0))) != (FORMAT, VERSION):
            raise InputError(f"{self.path}: version", arrays.get("version"), f"{FORMAT} {VERSION}; {REMOVE_WHEN_COLD}")
        state_arrays = {item.name: arrays[item.name] for item in fields(BudgetState)}
        columns: dict[str, Any] = {
            key: float(value) if value.ndim == 0 else value for key, value in state_arrays.items()
        }
        budget = BudgetState(**columns)
        if len(budget.rise_k) != len(cold.rise_k):
            expected = f"{len(cold.rise_k)}, the configured display's; {REMOVE_WHEN_COLD}"
            raise InputError(f"{self.path}: pixels", len(budget.rise_k), expected)
        if now_s < float(arrays["zero_s"]) - ZERO_OFFSET_S:
            raise InputError(
                "the time of day", now_s, f"a time after the last play according to {self.path}; {REMOVE_WHEN_COLD}"
            )
        return shift_state(budget, float(arrays["zero_s"]) - now_s)
