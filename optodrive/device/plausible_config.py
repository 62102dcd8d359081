"""Plausible values of a configuration's quantities, checked before its types: a wrong unit is told as such."""

from pathlib import Path
from typing import Any

from optodrive.core.errors import InputError
from optodrive.core.plausibility import check_table
from optodrive.core.plausible_ranges import RANGES
from optodrive.core.units import ZERO_CELSIUS_K

KELVIN_CAP_MIN = 423.0
"""Absorber caps from here on, 150 °C in K, are taken for K if they are whole or round in °C and not as they stand."""
ROUND_C = 5.0
TOLERANCE_K = 1e-6


def check_units(path: Path, table: dict[str, Any]) -> None:
    """Raise InputError for the first quantity of a configuration whose value suits another unit than its own."""
    check_table(str(path), table, RANGES["config"])
    limits = table.get("limits")
    cap_c = limits.get("absorber_max_c") if isinstance(limits, dict) else None
    if isinstance(cap_c, int | float) and _is_kelvin(float(cap_c)):
        expected = f"°C; this value is likely in K, {cap_c - ZERO_CELSIUS_K:.0f} °C"
        raise InputError(f"{path}: limits.absorber_max_c", cap_c, expected, "unit")


def _is_kelvin(cap: float) -> bool:
    """Return whether a cap that is possible in °C was probably converted to K, exactly or to a whole number."""
    highest = RANGES["config"]["limits.absorber_max_c"].high
    if not KELVIN_CAP_MIN <= cap <= highest or _is_multiple(cap, ROUND_C):
        return False
    return _is_multiple(cap - ZERO_CELSIUS_K, 1.0) or _is_multiple(cap - 273.0, ROUND_C)


def _is_multiple(value: float, step: float) -> bool:
    return abs(value - step * round(value / step)) < TOLERANCE_K
