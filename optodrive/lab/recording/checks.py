"""What a recording must hold; every function raises InputError, naming the place, where it does not."""

import numpy as np

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.types.arrays import FloatArray
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
    Unquoted,
    format_name,
)

AMBIENT_MIN_K, AMBIENT_MAX_K = 150.0, 600.0
PIXEL_MAX = 10**6
OVERLAP_MAX_S = 1e-9
"""Rounding of the times of abutting pulses."""
MODEL_PARAMETER_COUNT = 6
"""Parameters of the nominal model of a pixel; fewer samples than that say nothing about it."""


def check_format(where: str, head: Attributes) -> None:
    """Format and version."""
    for field, expected in (("format", FORMAT), ("version", VERSION)):
        if field not in head:
            raise InputError(f"{where}: {field}", None, f"{expected!r}")
        if head[field] != expected:
            raise InputError(f"{where}: {field}", head[field], f"{expected!r}, the one this release reads")


def pop_ambient_k(where: str, attributes: Attributes) -> float:
    """The ambient temperature, taken out of a run's attributes."""
    value = attributes.pop("ambient_K", None)
    if value is None:
        near = [name for name in attributes if name.lower().startswith("ambient")]
        hint = f" (there is {format_name(near[0])!r})" if near else ""
        raise InputError(f"{where}: ambient_K", None, f"the ambient temperature in K{hint}")
    if isinstance(value, str) or not AMBIENT_MIN_K <= value <= AMBIENT_MAX_K:
        raise InputError(
            f"{where}: ambient_K", value, f"a temperature between {AMBIENT_MIN_K:g} and {AMBIENT_MAX_K:g} K"
        )
    return float(value)


def select_signals(where: str, members: list[str]) -> list[str]:
    """The signals of a run in the format's order, once it is sure that all it needs is there and nothing unknown."""
    for member in members:
        if member not in RUN_MEMBERS:
            raise InputError(
                f"{where}/{format_name(member)}",
                Unquoted("an unknown name or unit"),
                suggest_nearest(member, list(RUN_MEMBERS)),
            )
    if PULSES not in members:
        raise InputError(f"{where}/{PULSES}", None, f"one row a pulse: {', '.join(TABLE_COLUMNS[PULSES])}")
    signals = [name for name in SIGNALS if name in members]
    if not signals:
        raise InputError(where, Unquoted("a run without signals"), f"at least one of {', '.join(SIGNALS)}")
    if COMMANDS not in members and set(signals) & set(MIRROR_SIGNALS):
        raise InputError(
            f"{where}/{COMMANDS}", None, f"what the mirrors were told: {', '.join(TABLE_COLUMNS[COMMANDS])}"
        )
    return signals


def check_pulses(where: str, pulses: FloatArray) -> None:
    """Finite entries, nothing negative, whole pixels, one beam. pulses: [n, 4]."""
    _check_finite(where, pulses, TABLE_COLUMNS[PULSES])
    for column, name in ((1, "width_s"), (2, "power_W")):
        _check_rows(f"{where}: {name}", pulses[:, column], pulses[:, column] >= 0, "no negative number")
    pixel = pulses[:, 3]
    whole = (pixel >= 0) & (pixel <= PIXEL_MAX) & (pixel == np.floor(pixel))
    _check_rows(f"{where}: pixel", pixel, whole, f"a whole number from 0 to {PIXEL_MAX}")
    _check_no_overlap(where, pulses)


def _check_no_overlap(where: str, pulses: FloatArray) -> None:
    order = np.argsort(pulses[:, 0], kind="stable")
    start_s = pulses[order, 0]
    # The longest reach of all pulses before, as a long pulse may still be on when the next but one begins.
    end_s = np.maximum.accumulate(start_s + pulses[order, 1])
    overlapping = np.flatnonzero(start_s[1:] < end_s[:-1] - OVERLAP_MAX_S)
    if overlapping.size:
        first = int(overlapping[0])
        raise InputError(
            f"{where}[{order[first + 1]}]: start_s",
            float(start_s[first + 1]),
            f"at least {float(end_s[first])!r}, where the pulse before ends: one beam lights one pixel at a time",
        )


def check_commands(where: str, commands: FloatArray) -> None:
    """Finite entries at increasing times. commands: [n, 3]."""
    _check_finite(where, commands, TABLE_COLUMNS[COMMANDS])
    _check_increasing(f"{where}: t_s", commands[:, 0])


def check_samples(where: str, t_s: FloatArray, value: FloatArray) -> None:
    """Times that increase; values that are finite or missing, not all of them missing."""
    if not t_s.size:
        raise InputError(where, Unquoted("no samples"), "at least one")
    _check_rows(f"{where}/t_s", t_s, np.isfinite(t_s), "a finite time in s")
    _check_increasing(f"{where}/t_s", t_s)
    _check_rows(f"{where}/value", value, ~np.isinf(value), "a finite value, or NaN where a sample is missing")
    if np.all(np.isnan(value)):
        raise InputError(
            f"{where}/value", Unquoted(f"{value.size} times NaN"), "at least one value that is not missing"
        )


def parse_pixel(where: str, signal: str, attributes: Attributes) -> int:
    """The index of the pixel measured."""
    value = attributes.get("pixel")
    if value is None and signal in MIRROR_SIGNALS:
        return 0
    if value is None or isinstance(value, str) or not (0 <= value <= PIXEL_MAX and value == int(value)):
        raise InputError(
            f"{where}: pixel", value, f"the index of the pixel measured, a whole number from 0 to {PIXEL_MAX}"
        )
    return int(value)


def parse_sigma(where: str, attributes: Attributes) -> float | None:
    """The instrument's stated noise; None where none is stated, which 0 says as well."""
    value = attributes.get("sigma")
    if value is None or value == 0:
        return None
    if isinstance(value, str) or not 0 < value < np.inf:
        raise InputError(f"{where}: sigma", value, "the instrument's noise, a positive number in the signal's unit")
    return float(value)


def check_unit(where: str, signal: str, attributes: Attributes) -> None:
    """A unit beside the signal, if there is one, is the one its name says."""
    for field in ("unit", "units"):
        if attributes.get(field, UNITS[signal]) != UNITS[signal]:
            raise InputError(f"{where}: {field}", attributes[field], f"'{UNITS[signal]}', as the signal's name says")


def check_sample_count(where: str, finite: int) -> None:
    """At least as many samples as the nominal model has parameters."""
    if finite < MODEL_PARAMETER_COUNT:
        raise InputError(
            where,
            Unquoted(f"{finite} samples that are not missing"),
            f"at least {MODEL_PARAMETER_COUNT}, as many as the model has parameters",
        )


def _check_finite(where: str, table: FloatArray, columns: tuple[str, ...]) -> None:
    for column, name in enumerate(columns):
        _check_rows(f"{where}: {name}", table[:, column], np.isfinite(table[:, column]), "a finite number")


def _check_increasing(where: str, t_s: FloatArray) -> None:
    falling = np.flatnonzero(t_s[1:] <= t_s[:-1])
    if falling.size:
        row = int(falling[0]) + 1
        expected = f"a time axis that rises: more than {float(t_s[row - 1])!r}, the time before"
        raise InputError(f"{where}[{row}]", float(t_s[row]), expected)


def _check_rows(where: str, values: FloatArray, is_valid: np.ndarray, expected: str) -> None:
    if not np.all(is_valid):
        row = int(np.argmin(is_valid))
        raise InputError(f"{where}[{row}]", float(values[row]), expected)
