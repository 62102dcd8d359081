"""Plausible ranges of quantities, and the unit that a value outside its range is probably in."""

from math import pi
from typing import NamedTuple

from optodrive.core.errors import InputError
from optodrive.core.units import ZERO_CELSIUS_K


class OtherUnit(NamedTuple):
    """A unit that a number may be in by mistake: SI value = factor · number + offset."""

    name: str
    factor: float
    offset: float = 0.0


OTHER_UNITS = {
    "m": (OtherUnit("mm", 1e-3), OtherUnit("µm", 1e-6), OtherUnit("nm", 1e-9)),
    "s": (OtherUnit("ms", 1e-3), OtherUnit("µs", 1e-6)),
    "W": (OtherUnit("mW", 1e-3), OtherUnit("µW", 1e-6)),
    "J": (OtherUnit("mJ", 1e-3), OtherUnit("µJ", 1e-6)),
    "N": (OtherUnit("mN", 1e-3), OtherUnit("µN", 1e-6)),
    "Hz": (OtherUnit("kHz", 1e3), OtherUnit("MHz", 1e6)),
    "rad": (OtherUnit("degrees", pi / 180.0), OtherUnit("mrad", 1e-3)),
    "rad/s": (OtherUnit("degrees/s", pi / 180.0),),
    "rad/s²": (OtherUnit("degrees/s²", pi / 180.0),),
    "°C": (OtherUnit("K", 1.0, -ZERO_CELSIUS_K),),
    "K": (OtherUnit("°C", 1.0, ZERO_CELSIUS_K), OtherUnit("mK", 1e-3)),
    "1": (OtherUnit("%", 1e-2),),
    "m/K": (OtherUnit("µm/K", 1e-6), OtherUnit("mm/K", 1e-3)),
    "N/K": (OtherUnit("mN/K", 1e-3), OtherUnit("µN/K", 1e-6)),
    "J/K": (OtherUnit("mJ/K", 1e-3), OtherUnit("µJ/K", 1e-6)),
}
"""Units in which numbers are given by mistake, likelier first, by the unit that is expected."""


class PlausibleRange(NamedTuple):
    """Range of the absolute values that a quantity of this unit can have."""

    low: float
    high: float
    unit: str


def guess_unit(value: float, plausible: PlausibleRange) -> str | None:
    """Return the other units in which a value lies within the range, likelier first, joined by "or"; None for none."""
    names = [
        other.name
        for other in OTHER_UNITS.get(plausible.unit, ())
        if plausible.low <= abs(other.factor * value + other.offset) <= plausible.high
    ]
    return " or ".join(names) or None


def check_plausible(where: str, value: float, plausible: PlausibleRange) -> None:
    """Raise InputError for a value outside its range whose unit is probably another one, or that no unit explains."""
    if value == 0.0 or plausible.low <= abs(value) <= plausible.high:
        return
    unit = guess_unit(value, plausible)
    likely = "" if unit is None else f"; this value is likely in {unit}"
    raise InputError(where, value, f"{plausible.low:g} to {plausible.high:g} {plausible.unit}{likely}", "unit")
