"""Conversions at the edges; inside, everything is SI and says its unit in its name."""

MICRO = 1e-6
ZERO_CELSIUS_K = 273.15


def um_to_m(value_um: float) -> float:
    """Micrometres to metres."""
    return value_um * MICRO


def m_to_um(value_m: float) -> float:
    """Metres to micrometres."""
    return value_m / MICRO
