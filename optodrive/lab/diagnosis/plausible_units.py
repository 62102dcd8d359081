"""Plausible units of a recording: each signal and drive against the response of a pixel, before anything is fitted.

The times are judged by the shape of a signal and not by its size: a time axis in ms beside pulses in s shows a response
where there is no drive. The values are judged by their size once the shape agrees, within a factor of `MAX_RATIO`,
which no pixel of the kind reaches and no wrong unit stays below. A signal without a response, such as that of a dead
pixel, is judged by absolute limits alone.
"""

from typing import NamedTuple, NoReturn

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.plausibility import check_plausible
from optodrive.core.plausible_ranges import RECORDING
from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.core.units import ZERO_CELSIUS_K
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, SIGNALS
from optodrive.physics.pixel import Pixel

MIRROR_SIGNALS = tuple(SIGNALS[kind] for kind in MIRROR_KINDS)
UNITS = {name: name.rpartition("_")[2] for name in SIGNALS}
PLAUSIBLE = RECORDING
WEAK_POWER_W = 5.0
"""Powers that respond a hundred times too weakly are taken for mW above this value."""
LENGTHS = ("bridge_width_m", "aim_x_m", "aim_y_m")
CHANGE_SIGNALS = ("displacement_m", "force_N")
"""Signals whose change is judged by its size, with or without a drive of their own pixel."""
MIRROR_SAMPLING_MAX_S = 5e-3
"""Longest median time between samples of a mirror; slower ones show nothing of a servo."""
AMBIENT_TOLERANCE_K = 100.0
"""A baseline this far below ambient is in another unit."""
NOISE_SIGMAS = 6.0
"""Noise beyond which a sample is outside its limits, in σ."""
MAX_RATIO, MAX_WEAKNESS = 25.0, 100.0
"""Largest ratio of a response to that of the reference pixel, and of the reference pixel to a response."""
SHAPE_AGREES, SHAPE_DISAGREES, SHAPE_CERTAIN = 0.8, 0.3, 0.97
"""Share of a signal's variance that a response explains for a match; share of the unexplained variance to which another
time unit reduces it, to be preferred; share explained above which no other unit is tried."""
LONG_PULSE_S, SHAPE_DISAGREES_LONG = 0.5, 0.7
"""Pulses above this width reach a plateau, which another time unit explains only a little better."""
MOVEMENT_AGREES = 0.5
"""Share of a mirror's variance that its commands explain for a match; a slow servo follows steps badly."""
CLOCK_OFFSETS_S = np.linspace(-5e-3, 5e-3, 21)
"""Offsets of an instrument's clock that are tried before another unit is: they are a cause that a diagnosis names."""
SAMPLES_MAX, PULSES_MAX = 300, 100
RESISTANCE_FACTORS = (0.5, 1.0, 2.0)
"""Thermal resistances tried, relative to the reference pixel's."""


class _TimeUnits(NamedTuple):
    """Factors from the stated numbers to seconds, and the quantity with its unit if they fit."""

    samples: float
    starts: float
    widths: float
    quantity: str
    unit: str


def _list_time_units() -> tuple[_TimeUnits, ...]:
    units = []
    for factor, unit in ((1e-3, "ms"), (1e-6, "µs")):
        units += [
            _TimeUnits(factor, 1.0, 1.0, "{signal}/t_s", unit),
            _TimeUnits(1.0, factor, factor, "pulses: start_s and width_s", unit),
            _TimeUnits(1.0, 1.0, factor, "pulses: width_s", unit),
            _TimeUnits(1.0, factor, 1.0, "pulses: start_s", unit),
            _TimeUnits(factor, factor, factor, "start_s, width_s and t_s", unit),
        ]
    return tuple(units)


TIME_UNITS = _list_time_units()


def check_recording_units(measurement: Measurement, pixel: Pixel, place: str = "recording") -> None:
    """Raise InputError for the first quantity that is probably in another unit than its name states.

    pixel: reference pixel, of which the recorded ones differ by less than a factor of `MAX_RATIO`
    """
    for run in measurement.runs:
        where = f"{place}: {run.name}"
        for name in LENGTHS:
            length = run.attributes.get(name)
            if isinstance(length, int | float):
                check_plausible(f"{where}: {name}", float(length), PLAUSIBLE[name])
        if len(run.pulses):
            check_plausible(f"{where}/pulses: power_W", float(run.pulses[:, 2].max()), PLAUSIBLE["pulses.power_W"])
        ratios: list[float] = []
        for name, signal in run.signals.items():
            finite = np.isfinite(signal.value)
            t_s, value = signal.t_s[finite], signal.value[finite]
            if len(value) < 2:
                continue
            _check_sigma(f"{where}/{name}: sigma", signal, value, UNITS[name])
            if name in MIRROR_SIGNALS:
                _check_mirror(where, run, name, t_s, value)
            else:
                ratio = _check_pixel_signal(where, run, name, signal.pixel, pixel, t_s, value)
                ratios += [] if ratio is None else [ratio]
        if ratios and max(ratios) < 1.0 / MAX_WEAKNESS and float(run.pulses[:, 2].max()) > WEAK_POWER_W:
            _refuse(f"{where}/pulses: power_W", f"{1.0 / max(ratios):.0f} times too much for the response", "W", "mW")


def _check_pixel_signal(
    where: str, run: Run, name: str, measured_pixel: int, pixel: Pixel, t_s: FloatArray, value: FloatArray
) -> float | None:
    """Check times and values of one signal. Return its size relative to the reference pixel's if shapes agree."""
    if name == "absorber_temperature_K":
        _check_temperature(f"{where}/{name}", run, t_s, value)
    own = run.pulses[run.pulses[:, 3] == measured_pixel]
    ratio = None
    if float((own[:, 1] * own[:, 2]).sum()) > 0.0:
        pulses, times_s, values = _thin(own, t_s, value)
        stated, ratio = _compare(name, pixel, pulses, times_s, values)
        likely = _find_time_units(name, pixel, pulses, times_s, values, stated)
        if likely is not None:
            quantity = likely.quantity.format(signal=name)
            _refuse(f"{where}/{quantity}", "times that do not suit the response", "s", likely.unit)
        if stated > SHAPE_AGREES and ratio > MAX_RATIO:
            _refuse_size(f"{where}/{name}", f"a response {ratio:.3g} times too large", ratio, UNITS[name])
        if stated <= SHAPE_AGREES:
            ratio = None
    if name in CHANGE_SIGNALS:
        median = float(np.median(value))
        change = max(float(value.max()) - median, median - float(value.min()))
        if change > PLAUSIBLE[name].high + NOISE_SIGMAS * _estimate_noise(value):
            check_plausible(f"{where}/{name}", change, PLAUSIBLE[name])
    return ratio


def _find_time_units(
    name: str, pixel: Pixel, pulses: FloatArray, t_s: FloatArray, value: FloatArray, stated: float
) -> _TimeUnits | None:
    """Return other units that explain the signal much better than the stated ones, with any clock offset, do."""
    is_long = float(pulses[:, 1].max()) > LONG_PULSE_S
    if stated >= SHAPE_CERTAIN and not is_long:
        return None
    margin = SHAPE_DISAGREES_LONG if is_long else SHAPE_DISAGREES
    trials = [(_compare_in(unit, name, pixel, pulses, t_s, value), unit) for unit in TIME_UNITS]
    explained, likely = max(trials, key=lambda item: item[0])
    if explained <= SHAPE_AGREES or 1.0 - explained >= margin * (1.0 - stated):
        return None
    shifted = max(_compare(name, pixel, pulses, t_s - late_s, value)[0] for late_s in CLOCK_OFFSETS_S)
    return likely if 1.0 - explained < margin * (1.0 - shifted) else None


def _check_temperature(where: str, run: Run, t_s: FloatArray, value: FloatArray) -> None:
    """Check the baseline, or the lowest values where there are hardly any samples before the first pulse."""
    first_s = float(run.pulses[:, 0].min()) if len(run.pulses) else np.inf
    before = value[t_s < first_s]
    baseline = float(np.median(before)) if len(before) >= 5 else float(np.quantile(value, 0.02))
    if float(np.median(value)) > PLAUSIBLE["absorber_temperature_K"].high:
        _refuse(where, f"{baseline:.6g} in the dark", "K", "mK")
    if baseline > run.ambient_k - AMBIENT_TOLERANCE_K:
        coldest, hottest, noise = float(value.min()), float(value.max()), NOISE_SIGMAS * _estimate_noise(value)
        if coldest < -noise or hottest > PLAUSIBLE["absorber_temperature_K"].high + noise:
            worst = coldest if coldest < -noise else hottest
            raise InputError(
                where, worst, f"temperatures above 0 K, up to {PLAUSIBLE['absorber_temperature_K'].high:g} K"
            )
        return
    ambient_c = run.ambient_k - ZERO_CELSIUS_K
    expected = {"°C": ambient_c, "°F": 1.8 * ambient_c + 32.0, "K above ambient": 0.0}
    unit = min(expected, key=lambda name: abs(expected[name] - baseline)) if len(before) >= 5 else "°C"
    _refuse(where, f"{baseline:.4g} in the dark at an ambient temperature of {run.ambient_k:g} K", "K", unit)


def _check_mirror(where: str, run: Run, name: str, t_s: FloatArray, value: FloatArray) -> None:
    """Check times and angles of one mirror against its commands."""
    if run.commands is None:
        return
    column = 1 + MIRROR_SIGNALS.index(name)
    command_s, command = run.commands[:, 0], run.commands[:, column]
    angle = ("x_rad", "y_rad")[column - 1]
    commanded = f"commands: {angle}"
    interval_s = float(np.median(np.diff(run.signals[name].t_s)))
    check_plausible(f"{where}/{commanded}", float(np.abs(command).max()), PLAUSIBLE[f"commands.{angle}"])
    check_plausible(f"{where}/{name}", float(np.abs(value).max()), PLAUSIBLE[name])
    stated, ratio = _explain(value, _hold(command_s, command, t_s))
    trials = [
        (_explain(value, _hold(command_s * commands, command, t_s * samples))[0], quantity, unit)
        for factor, unit in ((1e-3, "ms"), (1e-6, "µs"))
        for samples, commands, quantity in ((factor, 1.0, f"{name}/t_s"), (1.0, factor, "commands: t_s"))
    ]
    explained, quantity, unit = max(trials)
    if explained > MOVEMENT_AGREES and 1.0 - explained < SHAPE_DISAGREES * (1.0 - stated):
        _refuse(f"{where}/{quantity}", "times that do not suit the movement", "s", unit)
    if interval_s > MIRROR_SAMPLING_MAX_S:
        _refuse(f"{where}/{name}/t_s", f"a sample every {format_quantity(interval_s, 's')}", "s", "ms")
    if stated > SHAPE_AGREES and not 0.2 < ratio < 5.0:
        size = max(ratio, 1.0 / ratio)
        quantity = name if ratio > 1.0 else commanded
        _refuse(f"{where}/{quantity}", f"{size:.3g} times too much", "rad", "degrees" if size < 250.0 else "mrad")


def _check_sigma(where: str, signal: Signal, value: FloatArray, unit: str) -> None:
    """Check the stated noise against the span of the values."""
    span = float(np.ptp(value))
    if signal.sigma is not None and len(value) >= 100 and 0.0 < 100.0 * span < signal.sigma:
        _refuse_size(where, f"{signal.sigma / span:.3g} times the span of the values", signal.sigma / span, unit)


def _estimate_noise(value: FloatArray) -> float:
    """Return the standard deviation of noise between neighbouring samples."""
    return float(1.4826 * np.median(np.abs(np.diff(value))) / np.sqrt(2.0))


def _refuse(where: str, observed: str, unit: str, likely: str) -> NoReturn:
    raise InputError(where, Unquoted(observed), f"a quantity in {unit}; it is likely in {likely}", "unit")


def _refuse_size(where: str, observed: str, ratio: float, unit: str) -> NoReturn:
    """Refuse values that are too large by this ratio. The unit's prefix is the nearest power of a thousand."""
    step = int(np.clip(round(np.log10(ratio) / 3.0), 1, 3))
    _refuse(where, observed, unit, ("m", "µ", "n")[step - 1] + unit)


def _thin(pulses: FloatArray, t_s: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the first pulses and some of the samples before the next one, or of all if there are hardly any."""
    pulses = pulses[np.argsort(pulses[:, 0], kind="stable")]
    if len(pulses) > PULSES_MAX:
        early = t_s < pulses[PULSES_MAX, 0]
        if early.sum() >= 50:
            t_s, value = t_s[early], value[early]
        pulses = pulses[:PULSES_MAX]
    stride = max(1, len(t_s) // SAMPLES_MAX)
    return pulses, t_s[::stride], value[::stride]


def _compare_in(
    unit: _TimeUnits, name: str, pixel: Pixel, pulses: FloatArray, t_s: FloatArray, value: FloatArray
) -> float:
    scaled = pulses * [unit.starts, unit.widths, 1.0, 1.0]
    return _compare(name, pixel, scaled, t_s * unit.samples, value)[0]


def _compare(name: str, pixel: Pixel, pulses: FloatArray, t_s: FloatArray, value: FloatArray) -> tuple[float, float]:
    """Return the share of a signal's variance that the best of the reference responses explains, and its size."""
    return max(_explain(value, _compute_response(name, pixel, factor, pulses, t_s)) for factor in RESISTANCE_FACTORS)


def _compute_response(name: str, pixel: Pixel, factor: float, pulses: FloatArray, t_s: FloatArray) -> FloatArray:
    """Return the linear response of a pixel with another bridge resistance, in the signal's unit."""
    r_k_per_w = factor * pixel.r_k_per_w
    tau_s, gas_s = r_k_per_w * pixel.c_j_per_k, pixel.tau_g_s
    if abs(tau_s - gas_s) < 1e-2 * tau_s:
        gas_s = 0.98 * tau_s
    since_start = np.maximum(t_s[:, None] - pulses[:, 0], 0.0)
    since_end = np.maximum(t_s[:, None] - (pulses[:, 0] + pulses[:, 1]), 0.0)
    slow, fast = (np.exp(-since_end / tau) - np.exp(-since_start / tau) for tau in (tau_s, gas_s))
    scale = {
        "absorber_temperature_K": 1.0,
        "displacement_m": 0.5 * pixel.kappa_m_per_k,
        "force_N": 0.5 * pixel.phi_n_per_k,
    }[name]
    shape = slow if name == "absorber_temperature_K" else (tau_s * slow - gas_s * fast) / (tau_s - gas_s)
    return np.asarray(scale * r_k_per_w * pixel.epsilon * (shape @ pulses[:, 2]))


def _hold(command_s: FloatArray, command: FloatArray, t_s: FloatArray) -> FloatArray:
    """Return the command that holds at each time, 0 before the first."""
    row = np.searchsorted(command_s, t_s, side="right") - 1
    return np.asarray(np.where(row < 0, 0.0, command[np.maximum(row, 0)]))


def _explain(value: FloatArray, response: FloatArray) -> tuple[float, float]:
    """Return the share of the variance of values that a response with offset explains, and its factor, 0 for none."""
    x, y = response - response.mean(), value - value.mean()
    xx, yy = float(x @ x), float(y @ y)
    if xx <= 1e-300 or yy <= 1e-300:
        return 0.0, 0.0
    factor = float(x @ y) / xx
    return (factor**2 * xx / yy, factor) if factor > 0.0 else (0.0, 0.0)
