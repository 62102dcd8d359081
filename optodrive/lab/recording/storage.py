"""What both forms of a recording, the HDF5 file and the folder of CSV files, have in common."""

import datetime
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from optodrive.core.errors import InputError, abbreviate
from optodrive.core.types.arrays import FloatArray

Attributes = dict[str, str | float]

FORMAT = "optotactile-recording"
VERSION = 1
UNITS = {
    "absorber_temperature_K": "K",
    "displacement_m": "m",
    "force_N": "N",
    "mirror_x_rad": "rad",
    "mirror_y_rad": "rad",
}
SIGNALS = tuple(UNITS)
MIRROR_SIGNALS = ("mirror_x_rad", "mirror_y_rad")
"""Signals of the scanner: they need the run's commands, and belong to no pixel."""
PULSES = "pulses"
COMMANDS = "commands"
TABLE_COLUMNS = {PULSES: ("start_s", "width_s", "power_W", "pixel"), COMMANDS: ("t_s", "x_rad", "y_rad")}
"""Tables of a run and their columns."""
SAMPLE_COLUMNS = ("t_s", "value")
"""What a signal consists of."""
RUN_MEMBERS = (*TABLE_COLUMNS, *SIGNALS)

NUMBERS_MAX = 2**27
"""Numbers held in memory for one call: 1 GiB."""
TEXT_BYTES_MAX = 2**20
NAME_BYTES_MAX = 200
_INTEGER_MIN, _INTEGER_MAX = -(2**63), 2**64 - 1


class RecordingTree(Protocol):
    """A recording that is open, in either form: names and attributes at once, arrays when they are asked for."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *details: object) -> None: ...

    def format_place(self, *names: str) -> str:
        """The place in words: the recording, and the run, signal and field in it."""

    def read_root_attributes(self) -> Attributes:
        """Attributes of the whole."""

    def list_runs(self) -> list[str]:
        """Names of the runs, in any order."""

    def read_run_attributes(self, run: str) -> Attributes:
        """Attributes of a run."""

    def list_members(self, run: str) -> list[str]:
        """Names of a run's tables and signals, known or not."""

    def read_signal_attributes(self, run: str, signal: str) -> Attributes:
        """Attributes of a signal."""

    def read_table(self, run: str, name: str) -> FloatArray:
        """A table of a run, [n, columns]."""

    def read_samples(self, run: str, signal: str) -> tuple[FloatArray, FloatArray]:
        """Times and values of a signal, as many of the one as of the other."""

    def count_samples(self, run: str, signal: str) -> int:
        """How many samples a signal has, found without reading them."""


class MemoryBudget:
    """How many numbers may still be read into memory; a file may claim any size, and is asked before it is believed."""

    def __init__(self, numbers: int = NUMBERS_MAX) -> None:
        self._remaining = numbers

    def reserve(self, where: str, numbers: int) -> None:
        """Count numbers that are about to be read; InputError where that is too many."""
        self._remaining -= numbers
        if self._remaining < 0:
            raise InputError(
                where, f"{numbers} numbers", f"at most {NUMBERS_MAX} together; read large recordings in parts"
            )


@contextmanager
def convert_errors(place: str, expected: str) -> Iterator[None]:
    """Turn whatever a library raises at damaged data into one InputError."""
    try:
        with np.errstate(all="ignore"):
            yield
    except InputError:
        raise
    except Exception as error:
        # What h5py raises at damage is hardly limited: OSError, RuntimeError, KeyError, ValueError, TypeError, …
        raise InputError(place, Unquoted(_describe_error(error)), expected) from None


class Unquoted:
    """Text that an error message shows as it is, without quotes."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


def _describe_error(error: Exception) -> str:
    if isinstance(error, MemoryError | RecursionError):
        return "too much to be read"
    text = " ".join((getattr(error, "strerror", None) or str(error)).split()).strip("'\" ")
    # HDF5 says what it could not do and why in brackets: Unable to open file (truncated file: …)
    why = re.fullmatch(r"(?:Unable|Can't|Couldn't) .*?\((.+)\)", text)
    return (why[1] if why else text) or type(error).__name__


def format_name(name: object) -> str:
    """A name from a file, fit for one line of a message."""
    text = str(name)
    return text if text.isprintable() and len(text) <= NAME_BYTES_MAX else abbreviate(text)


def check_run_name(where: str, name: str) -> None:
    """Refuse a run's name that not both forms can carry: it is a group there and a folder here."""
    encoded = name.encode("utf-8", "replace")
    fits = name.isprintable() and not set(name) & {"/", "\\"} and not name.startswith(".")
    if not (fits and 0 < len(encoded) <= NAME_BYTES_MAX and name == name.strip()):
        raise InputError(
            where, name, f"a run's name: printable, at most {NAME_BYTES_MAX} bytes, no '/', '\\' or leading '.'"
        )


def natural_sort_key(name: str) -> tuple[object, ...]:
    """Sorting key by which run2 comes before run10."""
    parts = re.split(r"([0-9]+)", name)
    return (*(int(part) if index % 2 else part for index, part in enumerate(parts)), name)


def normalize_attribute(value: Any) -> str | float | None:
    """An attribute as str, int or float; None for what is none of them.

    Tools write the same attribute as a scalar, as an array of one, as bytes or as text.
    """
    if isinstance(value, np.ndarray):
        return normalize_attribute(value.reshape(-1)[0]) if value.size == 1 else None
    if isinstance(value, bytes):
        return _decode_text(value)
    if isinstance(value, str):
        return _decode_text(value.encode("utf-8", "replace"))
    if isinstance(value, bool | np.bool_ | int | np.integer):
        return int(value) if _INTEGER_MIN <= int(value) <= _INTEGER_MAX else None
    if isinstance(value, float | np.floating):
        return float(value)
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    return None


def _decode_text(value: bytes) -> str:
    # HDF5 ends text at a NUL; without any, both forms carry the same.
    return value[:TEXT_BYTES_MAX].decode("utf-8", "replace").replace("\0", "")


def normalize_attributes(values: dict[str, Any]) -> Attributes:
    """Those attributes that are text or a number."""
    converted = {name: normalize_attribute(value) for name, value in values.items() if name and name.isprintable()}
    return {name: value for name, value in converted.items() if value is not None}


def is_hdf5(path: Path) -> bool:
    """Whether a recording of this name is one HDF5 file rather than a folder."""
    return path.suffix.lower() in (".h5", ".hdf5")
