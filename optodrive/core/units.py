"""Unit conversions for interfaces, because internally all quantities are in SI units."""

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:  # every command imports this module
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
