"""The spots of a calibration, saved after each one so that an interrupted calibration can be resumed."""

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


class SpotRow(NamedTuple):
    """One spot: commanded codes and measured position, m."""

    x_code: float
    y_code: float
    x_m: float
    y_m: float


class CalibrationSession:
    """The spots of one calibration and their file beside the output file."""

    def __init__(self, path: Path, header: dict[str, Any], rows: list[SpotRow]) -> None:
        self.path, self.rows = path, rows
        self._header = header

    @classmethod
    def load_or_create(cls, out: Path, config: Config) -> Self:
        """Load the session of an output file, or create one. Raise InputError for a session of another display."""
        path = session_path_for(out)
        header = {
            "format": FORMAT,
            "version": VERSION,
            "display": config.name,
            "focal_length_m": config.scanner.focal_length_m,
            "rad_per_code": config.scanner.rad_per_code,
        }
        return cls(path, header, _read_rows(path, header) if path.exists() else [])

    @property
    def spots(self) -> MeasuredSpots:
        """All spots, in order of measurement."""
        return MeasuredSpots.from_table(np.array(self.rows, dtype=np.float64))

    def to_json(self) -> str:
        """Return the content of the file."""
        return json.dumps({**self._header, "spots": self.rows}) + "\n"


def session_path_for(out: Path) -> Path:
    """Return the path of an output file's session."""
    return out.with_name(out.name + ".session.json")


def save_text(path: Path, text: str) -> None:
    """Replace the file and flush it to disk."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _read_rows(path: Path, header: dict[str, Any]) -> list[SpotRow]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    except (ValueError, RecursionError):
        raise InputError(str(path), "not JSON", "a calibration's session; delete it to start again") from None
    for key, value in header.items():
        stored = document.get(key) if isinstance(document, dict) else None
        if stored != value:
            raise InputError(f"{path}: {key}", stored, f"{value!r}; delete the file to start again")
    try:
        rows = [SpotRow(*(float(number) for number in row)) for row in document["spots"]]
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: spots", "something else", "rows of x_code, y_code, x_m, y_m") from None
    if not np.all(np.isfinite(np.array(rows, dtype=np.float64))):
        raise InputError(f"{path}: spots", "a number that is not finite", "finite numbers")
    return rows
