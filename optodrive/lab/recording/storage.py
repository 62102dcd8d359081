"""Definitions and helpers common to both forms of a recording, HDF5 file and folder of CSV files."""

import datetime
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from optodrive.core.errors import InputError, Unquoted, abbreviate
from optodrive.core.toml_model import INTEGER_MAX, INTEGER_MIN, KEY_MAX
from optodrive.core.types.arrays import FloatArray

Attributes = dict[str, str | float]

FORMAT = "optotactile-recording"
VERSION = 1
SIGNALS = ("absorber_temperature_K", "displacement_m", "force_N", "mirror_x_rad", "mirror_y_rad")
UNITS = {name: name.rpartition("_")[2] for name in SIGNALS}
MIRROR_SIGNALS = ("mirror_x_rad", "mirror_y_rad")
"""Signals of the scanner: they require the run's commands and belong to no pixel."""
PULSES = "pulses"
COMMANDS = "commands"
TABLE_COLUMNS = {PULSES: ("start_s", "width_s", "power_W", "pixel"), COMMANDS: ("t_s", "x_rad", "y_rad")}
"""Tables of a run and their columns."""
SAMPLE_COLUMNS = ("t_s", "value")
"""Columns of a signal."""
RUN_MEMBERS = (*TABLE_COLUMNS, *SIGNALS)
PLAN_TABLES = {"planned": (*TABLE_COLUMNS[PULSES], "trimmed_J"), "executed": TABLE_COLUMNS[PULSES]}
"""Tables of a session's plan and their columns."""
PLAN_TEXTS = ("labels", "parameters")
"""JSON objects of a session's plan."""

HDF5_SUFFIXES = (".h5", ".hdf5")
"""Suffixes of recordings that are one file; any other name is that of a folder."""
NUMBERS_MAX = 2**27
"""Maximum of numbers read into memory per call: 1 GiB."""
TEXT_BYTES_MAX = 2**20
ATTRIBUTES_MAX = 1000
"""Maximum number of attributes of a recording, run or signal."""
NAME_BYTES_MAX = 200


class RecordingTree(Protocol):
    """An open recording in either form. Arrays are read on request."""

    path: Path

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None: ...

    def format_place(self, *names: str) -> str:
        """Return the place of a run, signal or field for messages, preceded by the recording's path."""
        return f"{self.path}: /{'/'.join(('runs', *names))}"

    def read_attributes(self, *names: str) -> Attributes:
        """Return the attributes of the recording, of a run, or of a signal, by the names of run and signal."""

    def list_runs(self) -> list[str]:
        """Return the run names in any order."""

    def list_members(self, run: str) -> list[str]:
        """Return the names of a run's tables and signals, known or not."""

    def read_table(self, run: str, name: str) -> FloatArray:
        """Return a table of a run, [n, columns]."""

    def read_samples(self, run: str, signal: str) -> tuple[FloatArray, FloatArray]:
        """Return the times and values of a signal, of equal length."""

    def count_samples(self, run: str, signal: str) -> int:
        """Return the number of samples of a signal without reading them."""


class MemoryBudget:
    """Limit on the numbers read into memory. A damaged file may claim any size."""

    def __init__(self, numbers: int = NUMBERS_MAX) -> None:
        self._remaining = numbers

    def reserve(self, place: str, numbers: int) -> None:
        """Count numbers that are about to be read. Raise InputError if the limit is exceeded."""
        self._remaining -= numbers
        if self._remaining < 0:
            expected = f"at most {NUMBERS_MAX} in total; read large recordings in parts"
            raise InputError(place, f"{numbers} numbers", expected)


@contextmanager
def convert_errors(place: str, expected: str) -> Iterator[None]:
    """Convert every exception that a library raises on damaged data into one InputError."""
    try:
        with np.errstate(all="ignore"):
            yield
    except InputError:
        raise
    except Exception as error:
        # h5py raises almost any type on damage: OSError, RuntimeError, KeyError, ValueError, TypeError, …
        raise InputError(place, Unquoted(_describe_error(error)), expected) from None


def _describe_error(error: Exception) -> str:
    if isinstance(error, MemoryError | RecursionError):
        return "too much data"
    text = " ".join((getattr(error, "strerror", None) or str(error)).split()).strip("'\" ")
    # HDF5 states the reason in parentheses: Unable to open file (truncated file: …)
    why = re.fullmatch(r"(?:Unable|Can't|Couldn't) .*?\((.+)\)", text)
    return (why[1] if why else text) or type(error).__name__


def format_name(name: object) -> str:
    """Return a name from a file shortened and escaped for a one-line message."""
    text = str(name)
    return text if text.isprintable() and len(text) <= NAME_BYTES_MAX else abbreviate(text)


def check_run_name(place: str, name: str) -> None:
    """Check that both forms can store a run's name, as an HDF5 group and as a folder."""
    encoded = name.encode("utf-8", "replace")
    fits = name.isprintable() and not set(name) & {"/", "\\"} and not name.startswith(".")
    if not (fits and 0 < len(encoded) <= NAME_BYTES_MAX and name == name.strip()):
        expected = f"a run's name: printable, at most {NAME_BYTES_MAX} bytes, no '/', '\\' or leading '.'"
        raise InputError(place, name, expected)


def natural_sort_key(name: str) -> tuple[object, ...]:
    """Return a sort key that orders run2 before run10."""
    parts = re.split(r"([0-9]+)", name)
    return (*(int(part) if index % 2 else part for index, part in enumerate(parts)), name)


def normalize_attribute(value: Any) -> str | float | None:
    """Return an attribute as str, int or float, or None for any other type.

    Writers store one attribute as a scalar, as an array of one element, as bytes or as text. A boolean becomes text, so
    that none counts as a number.
    """
    if isinstance(value, np.ndarray):
        return normalize_attribute(value.reshape(-1)[0]) if value.size == 1 else None
    if isinstance(value, bytes):
        return _decode_text(value)
    if isinstance(value, str):
        return _decode_text(value.encode("utf-8", "replace"))
    if isinstance(value, bool | np.bool_):
        return str(value).lower()
    if isinstance(value, int | np.integer):
        return int(value) if INTEGER_MIN <= int(value) <= INTEGER_MAX else None
    if isinstance(value, float | np.floating):
        return float(value)
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    return None


def _decode_text(value: bytes) -> str:
    # HDF5 ends text at a NUL character, so neither form stores one.
    return value[:TEXT_BYTES_MAX].decode("utf-8", "replace").replace("\0", "")


def normalize_attributes(values: dict[str, Any]) -> Attributes:
    """Return those attributes that are text or numbers."""
    names = [name for name in values if 0 < len(name) <= KEY_MAX and name.isprintable()]
    converted = {name: normalize_attribute(values[name]) for name in names}
    return {name: value for name, value in converted.items() if value is not None}


def is_hdf5(path: Path) -> bool:
    """Return whether a recording of this name is an HDF5 file rather than a folder."""
    return path.suffix.lower() in HDF5_SUFFIXES
