"""The reader of every TOML file, with bounds on its size, its depth, its keys and its numbers."""

import re
import tomllib
from pathlib import Path
from typing import Any

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.files import read_regular_file

BYTES_MAX = 1_000_000
"""Largest size of a file without another bound, bytes."""
DEPTH_MAX = 16
"""Most tables and lists within each other."""
KEY_MAX = 255
"""Longest key, characters."""
INTEGER_MIN, INTEGER_MAX = -(2**63), 2**64 - 1
"""Integers of 64 bits, with or without a sign: an attribute in HDF5 may be either."""
MESSAGE_MAX = 100
REMEDIES = {
    "Invalid value": "a number with a decimal point and without unit, true, false, or text in quotation marks",
    "Expected newline": "a number with a decimal point and without unit, true, false, or text in quotation marks",
    "Cannot overwrite": "each key once",
    "Cannot declare": "each section once",
}
"""What a writer most likely meant to state, by the beginning of the parser's message."""
LONG_DOTTED_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){128}""", re.ASCII)
"""A key, or text, of more parts than any file has; the parser's time is quadratic in their number."""


def read_toml(path: Path, bytes_max: int = BYTES_MAX, *, private: bool = False) -> dict[str, Any]:
    """Return a TOML file as a table. Raise InputError, in one line, if it cannot be read or parsed or passes a bound.

    private: require that only the file's owner can read it
    """
    return parse_toml(read_regular_file(path, bytes_max, private=private), str(path))


def parse_toml(content: bytes, where: str) -> dict[str, Any]:
    """Return TOML in UTF-8 as a table. Raise InputError, which shows no value of it, if it cannot be parsed."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{where}, line {line}", content[error.start : error.start + 1], "TOML in UTF-8") from None
    long_key = LONG_DOTTED_KEY.search(text)
    if long_key is not None:
        line = text.count("\n", 0, long_key.start()) + 1
        raise _build_depth_error(f"{where}, line {line}")
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message, _, place = str(error).rpartition(" (at ")
        remedy = next((f": {text}" for start, text in REMEDIES.items() if message.startswith(start)), "")
        found = Unquoted(message[:MESSAGE_MAX])
        raise InputError(f"{where}, {place.rstrip(')')}", found, f"valid TOML{remedy}") from None
    except RecursionError:
        raise _build_depth_error(where) from None
    except ValueError:  # of int()
        raise _build_integer_error(where) from None
    _check_bounds(where, table, 0)
    return table


def _check_bounds(where: str, value: object, depth: int) -> None:
    """Raise InputError for nesting that is too deep, a long or unprintable key, or a large integer."""
    if isinstance(value, dict | list) and depth == DEPTH_MAX:
        raise _build_depth_error(where)
    if isinstance(value, dict):
        separator = "." if depth else ": "
        for key, item in value.items():
            if len(key) > KEY_MAX or not key.isprintable():
                raise InputError(f"{where}: a key", key, f"at most {KEY_MAX} printable characters")
            _check_bounds(f"{where}{separator}{key}", item, depth + 1)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            _check_bounds(f"{where}[{index}]", item, depth + 1)
    elif isinstance(value, int) and not INTEGER_MIN <= value <= INTEGER_MAX:
        raise _build_integer_error(where)


def _build_depth_error(where: str) -> InputError:
    return InputError(where, Unquoted("deeper nesting"), f"tables and lists at most {DEPTH_MAX} deep")


def _build_integer_error(where: str) -> InputError:
    return InputError(where, Unquoted("an integer of more digits"), "integers of 64 bits")
