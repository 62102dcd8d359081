"""Check single values of decoded JSON, with errors that name the place, the value and the expected value.

A caller's labels, such as subject, block and trial, are recorded and never interpreted.
"""

import json
from collections.abc import Mapping, Sequence
from math import isfinite

from optodrive.core.errors import MISSING, InputError, suggest_nearest

PRIORITY_MAX = 1_000_000
"""Largest absolute priority."""

TIME_MAX_S = 86_400.0
"""Largest time in a sequence, s: one day, within which whole microseconds are exact in a float."""


def decode_json(body: bytes | str, where: str) -> object:
    """Decode JSON text (UTF-8). Raise InputError (bad_json) if it is invalid, repeats a key or nests too deep."""

    def require_unique_keys(pairs: list[tuple[str, object]]) -> dict[str, object]:
        table = dict(pairs)
        if len(table) < len(pairs):
            raise InputError(where, _find_repeated_key(pairs), "each key of an object once", code="bad_json")
        return table

    try:
        text = body.decode("utf-8-sig") if isinstance(body, bytes) else body
        return json.loads(text, object_pairs_hook=require_unique_keys)
    except UnicodeDecodeError as error:
        raise InputError(where, body[error.start : error.start + 4], "JSON in UTF-8", code="bad_json") from None
    except json.JSONDecodeError as error:
        near = error.doc[max(0, error.pos - 10) : error.pos + 10]
        expected = f"valid JSON ({error.msg}, line {error.lineno} column {error.colno})"
        raise InputError(where, near, expected, code="bad_json") from None
    except RecursionError:
        raise InputError(where, body[:20], "JSON that nests less deep", code="bad_json") from None
    except ValueError:
        raise InputError(
            where, "a number of thousands of digits", "numbers that fit a float", code="bad_json"
        ) from None


def _find_repeated_key(pairs: list[tuple[str, object]]) -> str | None:
    """Return the first key that repeats an earlier one, in linear time."""
    seen: set[str] = set()
    for key, _ in pairs:
        if key in seen:
            return key
        seen.add(key)
    return None


def require_object(value: object, where: str, known: Sequence[str], required: Sequence[str]) -> Mapping[str, object]:
    """Return a JSON object with known keys only and all required ones.

    Raises InputError (bad_json, unknown_key, missing_key).
    """
    if not isinstance(value, dict):
        raise InputError(where, value, "an object with " + ", ".join(known), code="bad_json")
    for key in value:
        if key not in known:
            expected = f"a known key, {suggest_nearest(str(key)[:60], list(known))}"
            raise InputError(where, key, expected, code="unknown_key")
    for key in required:
        if key not in value:
            raise InputError(f"{where}.{key}", MISSING, "this required key", code="missing_key")
    return value


def require_list(value: object, where: str, length_max: int) -> list[object]:
    """Return a JSON list of bounded length. Raise InputError (bad_json, too_many)."""
    if not isinstance(value, list):
        raise InputError(where, value, "a list", code="bad_json")
    if len(value) > length_max:
        raise InputError(where, len(value), f"at most {length_max} entries", code="too_many")
    return value


def require_number(value: object, where: str, expected: str, code: str) -> float:
    """Return a finite JSON number. Raise InputError for anything else. Booleans and strings are not numbers."""
    if type(value) is float and isfinite(value):
        return value
    if type(value) is int and abs(value) < 2**1000:
        return float(value)
    raise InputError(where, value, expected, code=code)


def require_priority(value: object, where: str) -> int:
    """Return the priority of a frame or train, an integer. Raise InputError (bad_priority)."""
    if type(value) is int and abs(value) <= PRIORITY_MAX:
        return value
    raise InputError(where, value, f"a whole number, -{PRIORITY_MAX}…{PRIORITY_MAX}", code="bad_priority")


def require_time(value: object, where: str, expected: str, code: str, *, positive: bool) -> float:
    """Return a time or duration in s, from 0 (or above 0 if positive) to one day. Raise InputError."""
    time_s = require_number(value, where, expected, code)
    if time_s < 0 or (positive and time_s == 0) or time_s > TIME_MAX_S:
        bound = f" (at most {TIME_MAX_S:.0f} s)" if time_s > TIME_MAX_S else ""
        raise InputError(where, value, expected + bound, code=code)
    return time_s


Labels = dict[str, str | int | float | bool]

LABELS_MAX = 32
KEY_MAX = 64
TEXT_MAX = 256
NUMBER_MAX = 2**53
EXPECTED_VALUE = f"text of at most {TEXT_MAX} printable characters, a finite number up to 2^53, true or false"


def parse_labels(value: object, where: str) -> Labels:
    """Return labels of decoded JSON. Raise InputError (bad_label, too_many) beyond their bounds."""
    if not isinstance(value, dict):
        raise InputError(where, value, "an object of labels", code="bad_label")
    if len(value) > LABELS_MAX:
        raise InputError(where, len(value), f"at most {LABELS_MAX} labels", code="too_many")
    for key, item in value.items():
        if not (0 < len(key) <= KEY_MAX and key.isprintable()):
            raise InputError(where, key[:KEY_MAX], f"keys of 1 to {KEY_MAX} printable characters", code="bad_label")
        if not _is_label(item):
            raise InputError(f"{where}.{key}", item, EXPECTED_VALUE, code="bad_label")
    return dict(value)


def _is_label(item: object) -> bool:
    if isinstance(item, str):
        return len(item) <= TEXT_MAX and (item.isprintable() or not item)
    return isinstance(item, bool | int | float) and abs(item) <= NUMBER_MAX  # false for NaN
