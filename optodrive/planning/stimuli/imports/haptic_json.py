"""Check objects, lists and numbers of haptic files, with errors that name the place."""

from collections.abc import Mapping

from optodrive.core.errors import MISSING, InputError
from optodrive.planning.stimuli.imports.haptic_content import LENGTH_MAX_S
from optodrive.planning.stimuli.json_values import require_number

CODE = "bad_haptic"
"""Code of the refusal of a file that is not as its format says."""
ENTRIES_MAX = 20_000


def require_table(value: object, where: str) -> Mapping[str, object]:
    """Return a JSON object. Raise InputError (bad_haptic)."""
    if not isinstance(value, dict):
        raise InputError(where, value, "an object", code=CODE)
    return value


def require_entries(table: Mapping[str, object], key: str, where: str) -> list[tuple[str, Mapping[str, object]]]:
    """Return the objects of a list with their places. Raise InputError (bad_haptic, too_many)."""
    entries, place = table.get(key, MISSING), f"{where}.{key}"
    if not isinstance(entries, list):
        raise InputError(place, entries, "a list", code=CODE)
    if len(entries) > ENTRIES_MAX:
        raise InputError(place, len(entries), f"at most {ENTRIES_MAX} entries", code="too_many")
    return [(f"{place}[{k}]", require_table(each, f"{place}[{k}]")) for k, each in enumerate(entries)]


def require_within(table: Mapping[str, object], key: str, where: str, low: float, high: float) -> float:
    """Return a number within bounds. Raise InputError (bad_haptic)."""
    place, expected = f"{where}.{key}", f"a number from {low:g} to {high:g}"
    number = require_number(table.get(key, MISSING), place, expected, CODE)
    if not low <= number <= high:
        raise InputError(place, number, expected, code=CODE)
    return number


def read_time(table: Mapping[str, object], key: str, where: str) -> float:
    """Return a time from 0 to the longest content, s. Raise InputError (bad_haptic)."""
    return require_within(table, key, where, 0.0, LENGTH_MAX_S)
