"""What a calibration has measured so far, on disk after every spot: an interrupted one goes on where it was."""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.files import atomic_write
from optodrive.device.config import Config
from optodrive.lab.calibration.spots import MeasuredSpots

FORMAT = "optodrive-calibration-session"
VERSION = 1


class Row(NamedTuple):
    """One spot: where it was sent, codes, and where it landed, m."""

    x_code: float
    y_code: float
    x_m: float
    y_m: float


class SessionFile:
    """The spots of one calibration, in a file beside what will come of it."""

    def __init__(self, path: Path, about: dict[str, Any], rows: list[Row]) -> None:
        self.path, self.rows = path, rows
        self._about = about

    @classmethod
    def beside(cls, out: Path, config: Config) -> Self:
        """The session of an output file, an earlier one or a new one; InputError for one of another display."""
        path = session_path(out)
        about = {
            "format": FORMAT,
            "version": VERSION,
            "display": config.name,
            "focal_length_m": config.scanner.focal_length_m,
            "rad_per_code": config.scanner.rad_per_code,
        }
        return cls(path, about, _read(path, about) if path.exists() else [])

    @property
    def spots(self) -> MeasuredSpots:
        """All rows, in order."""
        return MeasuredSpots.from_table(np.array(self.rows, dtype=np.float64))

    def text(self) -> str:
        """All of it, as the file holds it."""
        return json.dumps({**self._about, "spots": self.rows}) + "\n"


def session_path(out: Path) -> Path:
    """Where the session of an output file is kept."""
    return out.with_name(out.name + ".session.json")


def save(path: Path, text: str) -> None:
    """Replace the file, on disk when this returns."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _read(path: Path, about: dict[str, Any]) -> list[Row]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    except ValueError:
        raise InputError(str(path), "not JSON", "a calibration's session; delete it to begin anew") from None
    for key, value in about.items():
        given = found.get(key) if isinstance(found, dict) else None
        if given != value:
            raise InputError(f"{path}: {key}", given, f"{value!r}; delete the file to begin anew")
    try:
        rows = [Row(*(float(number) for number in row)) for row in found["spots"]]
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: spots", "something else", "rows of x_code, y_code, x_m, y_m") from None
    if not np.all(np.isfinite(np.array(rows, dtype=np.float64))):
        raise InputError(f"{path}: spots", "a number that is not finite", "finite numbers")
    return rows
