"""Text of a quantity, with digits, SI prefix and unit, and of a list, and conversions of units for interfaces.

Internally all quantities are in SI units. The expected value of an input field stays in the unit of the field, as the
user types it.
"""

from collections.abc import Sequence
from math import floor, isfinite, log10
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


Number = TypeVar("Number", float, "NDArray[np.float64]")

ZERO_CELSIUS_K = 273.15


def um_to_m(value_um: Number) -> Number:
    """Convert micrometres to metres, a number or an array."""
    return value_um * 1e-6


def m_to_um(value_m: Number) -> Number:
    """Convert metres to micrometres, a number or an array."""
    return value_m * 1e6


PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
SMALL_PREFIX_UNITS = ("m", "s", "W", "J", "N", "rad", "V", "A")
"""Leading units that take the prefixes n, µ and m."""
LARGE_PREFIX_UNITS = ("Hz",)
"""Leading units that take the prefixes k and M."""
MIN_PLAIN, MAX_PLAIN = 1e-4, 1e7
"""Magnitudes between which a number without prefix is written without a power of ten."""
MAX_NAMES = 4
"""Names that a list shows."""
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_quantity(value: float, unit: str, digits: int = 3) -> str:
    """Return a value with significant digits and its unit, with an SI prefix where the unit takes one: "60 µs"."""
    rounded = float(f"{value:.{digits}g}")  # 999.96 µs is 1 ms; the largest number becomes infinite
    if not isfinite(rounded) or rounded == 0.0:
        return _append_unit(f"{value:.{digits}g}", unit)
    exponent = _select_exponent(abs(rounded), unit)
    return _append_unit(format_number(rounded / 10.0**exponent, digits), PREFIXES[exponent] + unit)


def format_number(value: float, digits: int = 3) -> str:
    """Return a number with significant digits, without trailing zeros and exponent where it is readable without."""
    text = f"{value:.{digits}g}"
    rounded = float(text)
    if "e" not in text or not isfinite(rounded):
        return text
    if MIN_PLAIN <= abs(rounded) < MAX_PLAIN:
        return f"{rounded:.0f}"
    mantissa, _, power = f"{rounded:.{digits - 1}e}".partition("e")
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    return f"{mantissa}×10{str(int(power)).translate(SUPERSCRIPTS)}"


def format_range(low: float, high: float, unit: str, digits: int = 3) -> str:
    """Return a range with its unit: "1 µm to 3 mm"."""
    return f"{format_quantity(low, unit, digits)} to {format_quantity(high, unit, digits)}"


def list_names(names: Sequence[object], max_names: int = MAX_NAMES) -> str:
    """Return names as text, the first ones of many."""
    shown = ", ".join(map(str, names[:max_names]))
    return shown if len(names) <= max_names else f"{shown} and {len(names) - max_names} more"


def select_scale(magnitude: float, unit: str) -> tuple[float, str]:
    """Return the scale in which numbers up to a magnitude are readable, and its unit: 1e-6 and "µm" for 2e-5 m."""
    exponent = _select_exponent(magnitude, unit) if isfinite(magnitude) and magnitude > 0.0 else 0
    return 10.0**exponent, PREFIXES[exponent] + unit


def _select_exponent(magnitude: float, unit: str) -> int:
    """Return the power of ten of the prefix."""
    leading = unit.partition("/")[0]
    power = 3 * floor(floor(log10(magnitude)) / 3)
    if leading in SMALL_PREFIX_UNITS:
        return min(0, max(-9, power))
    return max(0, min(6, power)) if leading in LARGE_PREFIX_UNITS else 0


def _append_unit(number: str, unit: str) -> str:
    return number if unit in ("", "1") else f"{number} {unit.replace('^2', '²').replace('^3', '³')}"
