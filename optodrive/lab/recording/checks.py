"""Validity checks of a recording that raise InputError with the place of the violation."""

from collections.abc import Iterable
from difflib import get_close_matches

import numpy as np

from optodrive.core.errors import MISSING, InputError, Unquoted, suggest_nearest
from optodrive.core.plausibility import RECORDING, guess_unit
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Run
from optodrive.lab.recording.storage import (
    COMMANDS,
    FORMAT,
    MIRROR_SIGNALS,
    PULSES,
    RUN_MEMBERS,
    SIGNALS,
    TABLE_COLUMNS,
    UNITS,
    VERSION,
    Attributes,
    format_name,
)

AMBIENT = RECORDING["ambient_K"]
PIXEL_MAX = 10**6
LONG_PULSE_S = 0.1
"""Overlapping pulses above this width, s, that would not overlap a thousand times shorter, are taken to be in ms."""
OVERLAP_MAX_S = 1e-9
"""Tolerated overlap of consecutive pulses: the rounding error of their times."""
COUPLINGS = ("DC", "AC")
"""Couplings of the instruments' inputs."""
RUN_ATTRIBUTES = ("group", "aim_x_m", "aim_y_m", "bridge_width_m", "started_at", "coupling")
"""Attributes of a run that have a meaning, besides `ambient_K`."""
SIGNAL_ATTRIBUTES = ("pixel", "sigma", "unit", "units")
MISSPELT_SIMILARITY = 0.8
"""Similarity from which a free attribute is taken for a misspelt one, which would have no effect."""
MODEL_PARAMETER_COUNT = 6
"""Number of parameters of the nominal pixel model, which is the minimum number of finite samples in a recording."""


def check_format(place: str, head: Attributes) -> None:
    """Check the format name and the version in the root attributes."""
    for field, expected in (("format", FORMAT), ("version", VERSION)):
        if field not in head:
            raise InputError(f"{place}: {field}", MISSING, f"{expected!r}")
        if head[field] != expected:
            raise InputError(f"{place}: {field}", head[field], f"{expected!r}, the one this release reads")


def check_names(place: str, attributes: Attributes, known: tuple[str, ...]) -> None:
    """Raise InputError for an attribute that is likely one of the known ones, misspelt. Any other is free."""
    for name in attributes:
        if name not in known and get_close_matches(name, known, n=1, cutoff=MISSPELT_SIMILARITY):
            expected = f"{suggest_nearest(name, list(known))}, or a name that is less similar"
            raise InputError(place, name, expected, code="unknown_key")


def pop_ambient_k(place: str, attributes: Attributes) -> float:
    """Remove the ambient temperature from a run's attributes, check the names of the others, and return it, K."""
    value = attributes.pop("ambient_K", None)
    if value is None:
        near = [name for name in attributes if name.lower().startswith("ambient")]
        hint = f" (there is {format_name(near[0])!r})" if near else ""
        raise InputError(f"{place}: ambient_K", MISSING, f"the ambient temperature in K{hint}")
    if isinstance(value, str) or not AMBIENT.low <= value <= AMBIENT.high:
        unit = None if isinstance(value, str) else guess_unit(value, AMBIENT)
        likely = "" if unit is None else f"; this value is likely in {unit}"
        expected = f"a temperature between {AMBIENT.low:g} and {AMBIENT.high:g} K{likely}"
        raise InputError(f"{place}: ambient_K", value, expected)
    check_names(place, attributes, RUN_ATTRIBUTES)
    if attributes.get("coupling", "DC") not in COUPLINGS:
        raise InputError(f"{place}: coupling", attributes["coupling"], " or ".join(COUPLINGS))
    return float(value)


def select_signals(place: str, members: list[str]) -> list[str]:
    """Return the signals of a run in the format's order after checking that its members are known and complete."""
    for member in members:
        if member not in RUN_MEMBERS:
            expected = suggest_nearest(member, list(RUN_MEMBERS))
            raise InputError(f"{place}/{format_name(member)}", Unquoted("an unknown name or unit"), expected)
    if PULSES not in members:
        raise InputError(f"{place}/{PULSES}", MISSING, f"one row per pulse: {', '.join(TABLE_COLUMNS[PULSES])}")
    signals = [name for name in SIGNALS if name in members]
    if not signals:
        raise InputError(place, Unquoted("a run without signals"), f"at least one of {', '.join(SIGNALS)}")
    if COMMANDS not in members and set(signals) & set(MIRROR_SIGNALS):
        expected = f"the commanded mirror angles: {', '.join(TABLE_COLUMNS[COMMANDS])}"
        raise InputError(f"{place}/{COMMANDS}", MISSING, expected)
    return signals


def check_pulses(place: str, pulses: FloatArray) -> None:
    """Check that pulses [n, 4] are finite and nonnegative, have integer pixel indices and do not overlap in time."""
    _check_finite(place, pulses, TABLE_COLUMNS[PULSES])
    for column, name in ((1, "width_s"), (2, "power_W")):
        _check_rows(f"{place}: {name}", pulses[:, column], pulses[:, column] >= 0, "a number of at least 0")
    pixel = pulses[:, 3]
    is_index = (pixel >= 0) & (pixel <= PIXEL_MAX) & (pixel == np.floor(pixel))
    _check_rows(f"{place}: pixel", pixel, is_index, f"a whole number from 0 to {PIXEL_MAX}")
    _check_no_overlap(place, pulses)


def _check_no_overlap(place: str, pulses: FloatArray) -> None:
    """Check that no pulse starts before all earlier pulses have ended."""
    order = np.argsort(pulses[:, 0], kind="stable")
    start_s = pulses[order, 0]
    # The maximum over all earlier pulses: a long pulse may still be on when the pulse after next begins.
    end_s = np.maximum.accumulate(start_s + pulses[order, 1])
    overlapping = np.flatnonzero(start_s[1:] < end_s[:-1] - OVERLAP_MAX_S)
    if overlapping.size:
        apart = np.all(np.diff(start_s) >= 1e-3 * pulses[order[:-1], 1])
        if apart and float(pulses[:, 1].min()) > LONG_PULSE_S:
            longest = int(np.argmax(pulses[:, 1]))
            expected = "pulses in s that do not overlap; these widths are likely in ms"
            raise InputError(f"{place}[{longest}]: width_s", float(pulses[longest, 1]), expected, "unit")
        row = int(overlapping[0]) + 1
        end = f"{float(end_s[row - 1])!r}, the end of the previous pulse"
        expected = f"at least {end}: the beam addresses one pixel at a time"
        raise InputError(f"{place}[{order[row]}]: start_s", float(start_s[row]), expected)


def check_commands(place: str, commands: FloatArray) -> None:
    """Check that mirror commands [n, 3] are finite and that their times increase."""
    _check_finite(place, commands, TABLE_COLUMNS[COMMANDS])
    _check_increasing(f"{place}: t_s", commands[:, 0])


def check_samples(place: str, t_s: FloatArray, value: FloatArray) -> None:
    """Check that sample times increase and that values are finite or NaN, with at least one finite value."""
    if not t_s.size:
        raise InputError(place, Unquoted("no samples"), "at least one")
    _check_rows(f"{place}/t_s", t_s, np.isfinite(t_s), "a finite time in s")
    _check_increasing(f"{place}/t_s", t_s)
    _check_rows(f"{place}/value", value, ~np.isinf(value), "a finite value, or NaN where a sample is missing")
    if np.all(np.isnan(value)):
        raise InputError(f"{place}/value", Unquoted(f"{value.size} times NaN"), "at least one finite value")


def parse_pixel(place: str, signal: str, attributes: Attributes) -> int:
    """Return the index of the measured pixel. Mirror signals may omit it."""
    value = attributes.get("pixel")
    if value is None and signal in MIRROR_SIGNALS:
        return 0
    if value is None or isinstance(value, str) or not (0 <= value <= PIXEL_MAX and value == int(value)):
        expected = f"the index of the pixel measured, a whole number from 0 to {PIXEL_MAX}"
        raise InputError(f"{place}: pixel", value, expected)
    return int(value)


def parse_sigma(place: str, attributes: Attributes) -> float | None:
    """Return the stated noise of the instrument, or None where it is absent or 0."""
    value = attributes.get("sigma")
    if value is None or value == 0:
        return None
    if isinstance(value, str) or not 0 < value < np.inf:
        expected = "the instrument's noise: a positive number in the unit of the signal"
        raise InputError(f"{place}: sigma", value, expected)
    return float(value)


def check_unit(place: str, signal: str, attributes: Attributes) -> None:
    """Check that a unit attribute, if present, agrees with the unit in the signal's name."""
    for field in ("unit", "units"):
        if attributes.get(field, UNITS[signal]) != UNITS[signal]:
            expected = f"'{UNITS[signal]}', as stated in the signal's name"
            raise InputError(f"{place}: {field}", attributes[field], expected)


def check_sample_count(place: str, runs: Iterable[Run]) -> None:
    """Check that there are at least as many finite samples as the nominal model has parameters."""
    finite = sum(int(np.isfinite(signal.value).sum()) for run in runs for signal in run.signals.values())
    if finite < MODEL_PARAMETER_COUNT:
        expected = f"at least {MODEL_PARAMETER_COUNT}, the number of model parameters"
        raise InputError(place, Unquoted(f"{finite} finite samples"), expected)


def _check_finite(place: str, table: FloatArray, columns: tuple[str, ...]) -> None:
    for column, name in enumerate(columns):
        _check_rows(f"{place}: {name}", table[:, column], np.isfinite(table[:, column]), "a finite number")


def _check_increasing(place: str, t_s: FloatArray) -> None:
    falling = np.flatnonzero(t_s[1:] <= t_s[:-1])
    if falling.size:
        row = int(falling[0]) + 1
        expected = f"an increasing time axis: more than {float(t_s[row - 1])!r}, the previous time"
        raise InputError(f"{place}[{row}]", float(t_s[row]), expected)


def _check_rows(place: str, values: FloatArray, is_valid: np.ndarray, expected: str) -> None:
    if not np.all(is_valid):
        row = int(np.argmin(is_valid))
        raise InputError(f"{place}[{row}]", float(values[row]), expected)
