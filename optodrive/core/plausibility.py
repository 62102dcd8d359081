"""Plausible ranges of quantities, and the unit that a value outside its range is probably in.

The ranges at the end are those of absolute values in recordings and sequences; those of a TOML file stand at the fields
of its models. A place is the dotted key, without the indices of lists. A longest time of a day refuses nothing by
itself: times are judged against each other, or against the response.
"""

from collections.abc import Iterator, Mapping
from functools import cache
from math import inf, pi
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel

from optodrive.core.errors import InputError
from optodrive.core.quantity import ZERO_CELSIUS_K, format_range


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
    "1/s": (OtherUnit("1/ms", 1e3), OtherUnit("1/min", 1.0 / 60.0)),
    "1/K": (OtherUnit("%/K", 1e-2), OtherUnit("1/mK", 1e3)),
    "1/rad²": (OtherUnit("1/degrees²", (180.0 / pi) ** 2),),
    "1/rad⁴": (OtherUnit("1/degrees⁴", (180.0 / pi) ** 4),),
    "K/s": (OtherUnit("mK/s", 1e-3), OtherUnit("K/min", 1.0 / 60.0)),
    "K/W": (OtherUnit("K/mW", 1e3), OtherUnit("mK/W", 1e-3)),
    "m K/W": (OtherUnit("mm K/W", 1e-3), OtherUnit("µm K/W", 1e-6), OtherUnit("m K/mW", 1e3)),
    "m^2": (OtherUnit("mm²", 1e-6), OtherUnit("cm²", 1e-4), OtherUnit("µm²", 1e-12)),
    "m^3": (OtherUnit("mm³ (µl)", 1e-9), OtherUnit("cm³ (ml)", 1e-6)),
    "mm": (OtherUnit("m", 1e3), OtherUnit("µm", 1e-3)),
    "mW": (OtherUnit("W", 1e3), OtherUnit("µW", 1e-3)),
    "µm": (OtherUnit("m", 1e6), OtherUnit("mm", 1e3), OtherUnit("nm", 1e-3)),
    "m/K": (OtherUnit("µm/K", 1e-6), OtherUnit("mm/K", 1e-3)),
    "N/K": (OtherUnit("mN/K", 1e-3), OtherUnit("µN/K", 1e-6)),
    "J/K": (OtherUnit("mJ/K", 1e-3), OtherUnit("µJ/K", 1e-6)),
}
"""Units in which numbers are given by mistake, likelier first, by the unit that is expected."""


LARGEST = 1e300
"""Larger numbers suit no unit; an integer of thousands of digits is no float."""

NEAR = 2.0
"""Factor by which a value may exceed its range and still be in its unit as likely as in another one."""


class PlausibleRange(NamedTuple):
    """Range of the absolute values that a quantity of this unit can have."""

    low: float
    high: float
    unit: str


@cache
def collect_ranges(model: type[BaseModel]) -> Mapping[str, PlausibleRange]:
    """Collect the ranges in the annotations of a model's fields, by dotted key without the indices of lists.

    A field that holds a table without a model states a mapping of ranges by its keys.
    """
    found: dict[str, PlausibleRange] = {}
    for name, field in model.model_fields.items():
        for part in (*field.metadata, *_list_parts(field.annotation)):
            if isinstance(part, PlausibleRange):
                found[name] = part
                continue
            is_model = isinstance(part, type) and issubclass(part, BaseModel)
            inner = collect_ranges(part) if is_model else part if isinstance(part, Mapping) else {}
            found |= {f"{name}.{key}": plausible for key, plausible in inner.items()}
    return found


def _list_parts(annotation: Any) -> Iterator[Any]:
    """Yield a type and all that it is made of, with its annotations."""
    yield annotation
    for part in get_args(annotation):
        yield from _list_parts(part)


def guess_unit(value: float, plausible: PlausibleRange) -> str | None:
    """Return the other units in which a value lies within the range, likelier first, joined by "or", or None."""
    if abs(value) >= LARGEST:
        return None
    names = [
        other.name
        for other in OTHER_UNITS.get(plausible.unit, ())
        if plausible.low <= abs(other.factor * value + other.offset) <= plausible.high
    ]
    return " or ".join(names) or None


def describe_likely_unit(value: float, plausible: PlausibleRange) -> str:
    """Return the end of a message that names the units in which a value suits its range, empty if there are none.

    A value just beyond the range may be too small or too large in the right unit.
    """
    unit = guess_unit(value, plausible)
    is_near = plausible.low / NEAR <= abs(value) <= plausible.high * NEAR and plausible.unit not in ("K", "°C")
    if unit is None:
        return ""
    return f"; this value is just beyond it, or in {unit}" if is_near else f"; this value is likely in {unit}"


def check_plausible(where: str, value: float, plausible: PlausibleRange) -> None:
    """Raise InputError for a value outside its range whose unit is probably another one, or that no unit explains."""
    if value == 0.0 or plausible.low <= abs(value) <= plausible.high:
        return
    raise InputError(where, value, f"{format_range(*plausible)}{describe_likely_unit(value, plausible)}", "unit")


def check_table(where: str, table: Mapping[str, object], ranges: Mapping[str, PlausibleRange]) -> None:
    """Raise InputError for the first number of a decoded file outside its range, with the unit that it suits, if any.

    ranges: by dotted key, without the indices of lists. What is zero or not finite is left to the schema.
    """
    for key, value in table.items():
        _check_value(where, key, key, value, ranges)


def _check_value(where: str, key: str, place: str, value: object, ranges: Mapping[str, PlausibleRange]) -> None:
    if not any(known == key or known.startswith(f"{key}.") for known in ranges):
        return
    if isinstance(value, Mapping):
        for name, item in value.items():
            _check_value(where, f"{key}.{name}", f"{place}.{name}", item, ranges)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            _check_value(where, key, f"{place}[{index}]", item, ranges)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        plausible = ranges.get(key)
        if plausible is not None and abs(value) < inf:
            check_plausible(f"{where}: {place}", value, plausible)


TEMPERATURE = PlausibleRange(150.0, 3000.0, "K")
MIRROR_ANGLE = PlausibleRange(0.0, 0.9, "rad")
DAY = PlausibleRange(0.0, 86_400.0, "s")

RECORDING = {
    "ambient_K": PlausibleRange(150.0, 600.0, "K"),
    "bridge_width_m": PlausibleRange(1e-5, 5e-3, "m"),
    "aim_x_m": PlausibleRange(0.0, 5e-3, "m"),
    "aim_y_m": PlausibleRange(0.0, 5e-3, "m"),
    "pulses.start_s": DAY,
    "pulses.width_s": DAY,
    "pulses.power_W": PlausibleRange(0.0, 60.0, "W"),
    "commands.t_s": DAY,
    "commands.x_rad": MIRROR_ANGLE,
    "commands.y_rad": MIRROR_ANGLE,
    "signal.t_s": DAY,
    "absorber_temperature_K": TEMPERATURE,
    "displacement_m": PlausibleRange(1e-8, 5e-3, "m"),
    "force_N": PlausibleRange(1e-5, 5.0, "N"),
    "mirror_x_rad": MIRROR_ANGLE,
    "mirror_y_rad": MIRROR_ANGLE,
}
FRAMES = {
    "frames.show_at_s": DAY,
    "frames.duration_s": DAY,
    "frames.target_um": PlausibleRange(1.0, 10_000.0, "µm"),
    "trains.start_s": DAY,
    "trains.duration_s": DAY,
    "trains.pulse_width_s": PlausibleRange(1e-7, 0.07, "s"),
    "trains.gap_s": PlausibleRange(1e-7, 60.0, "s"),
    "trains.period_s": PlausibleRange(1e-6, 60.0, "s"),
    "trains.power_w": PlausibleRange(1e-4, 60.0, "W"),
    "trains.target_um": PlausibleRange(1.0, 10_000.0, "µm"),
    "trains.peak_to_peak_um": PlausibleRange(0.5, 10_000.0, "µm"),
}
