"""Power of the laser over its duty: proportional, or by the table that a power meter has measured.

A curve [k, 2] of duty and power in W runs from (0, 0) to the full power at duty 1, and is linear in between. An empty
one states proportion.
"""

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.numeric_tables import open_table
from optodrive.core.types.arrays import FloatArray

Curve = Sequence[Sequence[float]]
"""Pairs of duty and power, W."""
COLUMNS = "duty", "power_W"
ROWS_MIN = 5
"""Rows of a power meter's table, that at full duty included."""
METER_NOISE = 0.002
"""Share of the full power below which a reading is that of a dark laser."""
POWER_MAX_W = 60.0
"""More than any diode of such a display emits."""
ROUNDING = 1e-9
"""Relative rounding error of a power that went through a curve and back."""


def compute_power_w(duty: FloatArray, full_power_w: float, curve: Curve) -> FloatArray:
    """Return the mean power at a duty, any shape, W."""
    if not curve:
        return np.asarray(duty * full_power_w, dtype=np.float64)
    duties, powers_w = np.transpose(curve)
    return np.asarray(np.interp(duty, duties, powers_w), dtype=np.float64)


def compute_duty(power_w: FloatArray, full_power_w: float, curve: Curve) -> FloatArray:
    """Return the duty of a mean power, W, any shape: 0 for no power, above 1 for more than full power."""
    share = np.asarray(power_w / full_power_w, dtype=np.float64)
    if not curve:
        return share
    duties, powers_w = np.transpose(curve)
    # Of the duties up to which nothing is emitted only the last one lies on a way to a power.
    first = int(np.flatnonzero(powers_w > 0.0)[0]) - 1
    duty = np.interp(power_w, powers_w[first:], duties[first:])
    return np.asarray(np.where((power_w > 0.0) & (share <= 1.0), duty, share), dtype=np.float64)


def find_min_power_w(full_power_w: float, curve: Curve, threshold_w: float, steps: int) -> float:
    """Return the power, W, of the smallest of `steps` steps of the duty at which a laser emits its threshold, W."""
    lowest = float(compute_duty(np.array(threshold_w), full_power_w, curve)) if threshold_w > 0.0 else 0.0
    step = max(1, ceil(lowest * steps * (1.0 - ROUNDING)))
    power_w = compute_power_w(np.array([step, step + 1]) / steps, full_power_w, curve)
    # Rounding may leave the step a trace below its threshold.
    return float(power_w[0] if power_w[0] >= threshold_w else power_w[1])


def find_proportional_power_w(full_power_w: float, curve: Curve) -> float:
    """Return the full power, W, of the weakest laser in proportion that nowhere emits less than this one."""
    return max((power_w / duty for duty, power_w in curve if duty > 0.0), default=full_power_w)


def find_proportion_excess(full_power_w: float, curve: Curve, min_power_w: float) -> float:
    """Return the largest factor by which that laser emits more than this one, at any power from min_power_w, W, on."""
    counted_w = find_proportional_power_w(full_power_w, curve)
    powers_w = np.array([min_power_w, *(power_w for _, power_w in curve if power_w > min_power_w)])
    return float((compute_duty(powers_w, full_power_w, curve) * counted_w / powers_w).max()) if curve else 1.0


class MeasuredPower(NamedTuple):
    """The keys of the section [laser] that a power meter's table gives: full power and threshold, W, and the curve."""

    max_power_w: float
    threshold_w: float
    curve: tuple[tuple[float, float], ...]

    def to_toml(self, source: str) -> str:
        """Return the part of a configuration.

        source: the table's name
        """
        printable = "".join(letter for letter in source if letter.isprintable())
        rows = "".join(f"  [{duty:.6g}, {power_w:.6g}],\n" for duty, power_w in self.curve)
        return (
            f"# measured at the sample: {printable}\n[laser]\nmax_power_w = {self.max_power_w:.6g}\n"
            f"threshold_w = {self.threshold_w:.6g}\ncurve = [\n{rows}]\n"
        )


def read_power_table(path: Path) -> MeasuredPower:
    """Read the duties and powers that a power meter has measured, a CSV file with rows in any order.

    Readings of no more than METER_NOISE count as dark, and the last duty of these as dark, too. Raises InputError for
    too few rows, another unit, a duty that stands twice, no full duty, and power that does not rise with the duty.
    """
    with open_table(path, COLUMNS, aliases={"power_W": "watts"}) as file:
        # Rounded as they are written, so that rows that differ here differ there.
        table = np.vectorize(lambda value: float(f"{value:.6g}"))(file.read_numbers(finite=True))
    if len(table) < ROWS_MIN:
        raise InputError(str(path), Unquoted(f"{len(table)} rows"), f"at least {ROWS_MIN} duties, 1 among them")
    duty, power_w = table[np.argsort(table[:, 0], kind="stable")].T
    for name, values, high, other in (("duty", duty, 1.0, "%"), ("power_W", power_w, POWER_MAX_W, "mW")):
        if values[-1] > high or values.max() > high or values.min() < (0.0 if name == "duty" else -POWER_MAX_W):
            worst = float(values.max() if values.max() > high else values.min())
            raise InputError(f"{path}: {name}", worst, f"0 to {high:g}; this value is likely in {other}")
    full_w = float(power_w[-1])
    if duty[-1] != 1.0 or full_w <= 0.0:
        raise InputError(f"{path}: duty", float(duty[-1]), "a last row at duty 1 with light")
    power_w = np.where(power_w <= METER_NOISE * full_w, 0.0, power_w)
    rows = [(0.0, 0.0)]
    for each_duty, each_w in zip(duty.tolist(), power_w.tolist(), strict=True):
        place, (before_duty, before_w) = f"{path}: duty {each_duty:g}", rows[-1]
        if each_duty == 0.0:
            if each_w > 0.0:
                raise InputError(
                    place, Unquoted(f"{each_w:g} W"), "no light at duty 0: zero the meter with the laser off"
                )
        elif each_duty == before_duty:
            raise InputError(place, Unquoted("two rows"), "each duty once")
        elif each_w < before_w or each_w == before_w > 0.0:
            expected = f"more than {before_w:g} W, the power at duty {before_duty:g}"
            raise InputError(place, Unquoted(f"{each_w:g} W"), expected)
        else:
            rows.append((each_duty, each_w))
    dark = [number for number, (each_duty, each_w) in enumerate(rows) if each_duty > 0.0 == each_w]
    return MeasuredPower(rows[-1][1], rows[dark[-1] + 1][1] if dark else 0.0, tuple(rows))
