"""The limits of a simulated board: read from a file, and tightened by a host."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from re import fullmatch
from typing import Any

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.toml_model import read_toml
from optodrive.link.protocol.messages import POINTS_MAX, Limits

DEFAULT_LIMITS = Limits(
    max_on_us=50_000,
    max_duty=65535,
    mean_duty=65535,
    spot_uj=150_000,
    spot_leak_uw=1_400_000,
    full_power_uw=2_450_000,
    x_min=0,
    x_max=65535,
    y_min=0,
    y_max=65535,
    settle_us=200,
    settle_ns_per_code=50,
    rest_us=500,
    lease_ms=100,
)
FIELD_MAX = {"H": 0xFFFF, "I": 0xFFFF_FFFF}
SETTING_RANGES = {
    item.name: (0, FIELD_MAX[code]) for item, code in zip(fields(Limits), Limits.LAYOUT.format[1:], strict=True)
}
CELLS_MAX, WINDOW_PULSES_MAX = 8192, 8192
SETTING_RANGES |= {"cell_codes": (1, 0xFFFF), "queue_points": (POINTS_MAX, 0xFFFF)}
SETTING_RANGES |= {"cells": (1, CELLS_MAX), "window_pulses": (1, WINDOW_PULSES_MAX)}
UPPER_LIMITS = ("max_on_us", "max_duty", "mean_duty", "spot_uj", "spot_leak_uw", "x_max", "y_max", "lease_ms")
LOWER_LIMITS = ("x_min", "y_min", "settle_us", "settle_ns_per_code", "rest_us")


def tighten(current: Limits, requested: Limits) -> Limits:
    """Return the tighter value of each field. full_power_uw stays as it is."""
    tighter = {name: min(getattr(current, name), getattr(requested, name)) for name in UPPER_LIMITS}
    tighter |= {name: max(getattr(current, name), getattr(requested, name)) for name in LOWER_LIMITS}
    return replace(current, **tighter)


@dataclass(frozen=True)
class BoardSettings:
    """Settings of a simulated board: its own limits, its identity, and the sizes of its guards.

    cell_codes: of a cell, in codes; cells: accounts in each grid; window_pulses: pulses in a second
    """

    limits: Limits = DEFAULT_LIMITS
    uid: str = "73696d756c61746564303031"
    cell_codes: int = 1300
    queue_points: int = 4096
    cells: int = 2048
    window_pulses: int = WINDOW_PULSES_MAX
    key_edge: bool = False


def load_settings(path: Path) -> BoardSettings:
    """Load settings from a TOML file: any field of the limits, and of the settings besides.

    Raise InputError for an unknown key or a value out of range.
    """
    table = read_toml(path)
    known = [*SETTING_RANGES, "uid", "key_edge"]
    for name, value in table.items():
        if name not in known:
            raise InputError(f"{path}", name, f"a known key, {suggest_nearest(name, known)}")
        _check_setting(f"{path}: {name}", name, value)
    return build_settings(table)


def build_settings(table: dict[str, Any]) -> BoardSettings:
    """Return the settings with the values of a table of known keys."""
    limits = replace(DEFAULT_LIMITS, **{name: value for name, value in table.items() if hasattr(DEFAULT_LIMITS, name)})
    return BoardSettings(limits, **{name: value for name, value in table.items() if not hasattr(DEFAULT_LIMITS, name)})


def _check_setting(where: str, name: str, value: object) -> None:
    if name == "uid":
        if not isinstance(value, str) or not fullmatch("[0-9a-fA-F]{24}", value):
            raise InputError(where, value, "24 hexadecimal digits")
    elif name == "key_edge":
        if not isinstance(value, bool):
            raise InputError(where, value, "true or false")
    else:
        low, high = SETTING_RANGES[name]
        if type(value) is not int or not low <= value <= high:
            raise InputError(where, value, f"a whole number from {low} to {high}")
