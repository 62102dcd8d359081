"""Checks of a recording before anything is fitted: finite numbers, repeats that are no copies, plausible units.

Limits of the numbers keep the diagnosis finite in time and free of overflow. Copies among the runs would pass for
repeats with very little noise.

Units are judged by the response of a pixel. The times are judged by the shape of a signal and not by its size: a time
axis in ms beside pulses in s shows a response where there is no drive. The values are judged by their size once the
shape agrees, within a factor of `MAX_RATIO`, which no pixel of the kind reaches and no wrong unit stays below. A signal
without a response, such as that of a dead pixel, is judged by absolute limits alone.
"""

from hashlib import sha256
from typing import NamedTuple, NoReturn

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.plausibility import RECORDING, check_plausible
from optodrive.core.quantity import ZERO_CELSIUS_K, format_quantity
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, SIGNALS
from optodrive.lab.diagnosis.noise_model import estimate_resolution
from optodrive.lab.inference.noise import estimate_noise
from optodrive.lab.inspection.response_faults import compute_template, thin
from optodrive.physics.pixel import Pixel

MAX_MAGNITUDE = 1e9
"""Largest magnitude of a sample or of a pulse's power, SI; statistics hold fourth powers of it."""
MAX_TIME_S = 1e4
"""Latest end of a pulse or command, and longest duration of all runs together: each of some thousand predictions
integrates it in steps of milliseconds."""
MIN_SPACING_S = 1e-9
"""Shortest time between two samples."""
MIN_NOISE = 3.0
"""Noise of equal samples, in resolutions, from which they are a copy: a simulation without noise stays below it."""
MIN_WHITENESS = 0.5
"""Third differences of neighbouring samples over those of every second one: 1 for white noise, 1/8 if smooth."""
MIN_SAMPLES, MAX_INTERVAL_S = 20, 2e-3
"""Minimum number of samples of a signal whose noise is estimated; their maximum interval, shorter than a response."""
MIRROR_SIGNALS = tuple(SIGNALS[kind] for kind in MIRROR_KINDS)
UNITS = {name: name.rpartition("_")[2] for name in SIGNALS}
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
MIN_SHAPE_SAMPLES = 8
"""Smallest number of samples of a response; fewer agree with one in some unit by chance."""
SHAPE_AGREES, SHAPE_DISAGREES, SHAPE_CERTAIN = 0.8, 0.3, 0.97
"""Share of a signal's variance that a response explains for a match; share of the unexplained variance to which another
time unit reduces it, to be preferred; share explained above which no other unit is tried."""
LONG_PULSE_S, SHAPE_DISAGREES_LONG = 0.5, 0.7
"""Pulses above this width reach a plateau, which another time unit explains only a little better."""
MOVEMENT_AGREES = 0.5
"""Share of a mirror's variance that its commands explain for a match; a slow servo follows steps badly."""
CLOCK_OFFSETS_S = np.linspace(-5e-3, 5e-3, 21)
"""Offsets of an instrument's clock that are tried before another unit is: they are a cause that a diagnosis names."""
RESISTANCE_FACTORS = (0.5, 1.0, 2.0)
"""Thermal resistances tried, relative to the reference pixel's."""


def check_numeric_limits(measurement: Measurement) -> None:
    """Raise InputError for a number that a diagnosis cannot compute with."""
    for run in measurement.runs:
        place = f"/runs/{run.name}"
        if len(run.pulses):
            _check_magnitude(f"{place}/pulses: start_s", run.pulses[:, 0], MAX_TIME_S, "s")
            _check_magnitude(f"{place}/pulses: width_s", run.pulses[:, 1], MAX_TIME_S, "s")
            _check_magnitude(f"{place}/pulses: power_W", run.pulses[:, 2], MAX_MAGNITUDE, "W")
        if run.commands is not None and len(run.commands):
            _check_magnitude(f"{place}/commands: t_s", run.commands[:, 0], MAX_TIME_S, "s")
            _check_magnitude(f"{place}/commands", run.commands[:, 1:], MAX_MAGNITUDE, "rad")
        for name, signal in run.signals.items():
            finite = signal.value[np.isfinite(signal.value)]
            _check_magnitude(f"{place}/{name}", finite, MAX_MAGNITUDE, name.rsplit("_", 1)[1])
            _check_magnitude(f"{place}/{name}/t_s", signal.t_s, MAX_TIME_S, "s")
            spacing_s = float(np.diff(signal.t_s).min(initial=np.inf))
            if not spacing_s >= MIN_SPACING_S:
                found = Unquoted(f"samples {spacing_s:.3g} s apart")
                raise InputError(
                    f"{place}/{name}/t_s", found, f"{MIN_SPACING_S:g} s at least; time stamps of SI seconds"
                )
    _check_duration(measurement.runs)


def _check_magnitude(place: str, numbers: FloatArray, limit: float, unit: str) -> None:
    magnitude = np.abs(numbers)
    if len(numbers) and not magnitude.max() <= limit:
        worst = float(numbers.reshape(-1)[magnitude.argmax()])
        raise InputError(place, worst, f"a magnitude of at most {limit:g} {unit}")


def _check_duration(runs: tuple[Run, ...]) -> None:
    ends_s = [max((float(signal.t_s[-1]) for signal in run.signals.values()), default=0.0) for run in runs]
    if sum(ends_s) > MAX_TIME_S:
        longest = int(np.argmax(ends_s))
        found = f"{sum(ends_s):.0f} s of runs, {ends_s[longest]:.0f} s of them in {runs[longest].name}"
        raise InputError("recording", Unquoted(found), f"at most {MAX_TIME_S:g} s from the starts to the last samples")


def check_copied_runs(measurement: Measurement) -> None:
    """Raise InputError if a run with noise is a copy of another one: the same pulses, samples and signals."""
    first: dict[bytes, Run] = {}
    for run in measurement.runs:
        content = sha256(run.pulses.tobytes())
        for name in sorted(run.signals):
            content.update(run.signals[name].value.tobytes())
        twin = first.setdefault(content.digest(), run)
        if twin is not run and any(_has_noise(signal) for signal in run.signals.values()):
            raise InputError(
                f"recording: {run.name}", Unquoted(f"a copy of {twin.name}"), "a repeat that was recorded on its own"
            )


def _has_noise(signal: Signal) -> bool:
    """Return whether neighbouring samples differ as noise does: above the resolution, and as much as distant ones."""
    finite = signal.value[np.isfinite(signal.value)]
    if len(finite) < MIN_SAMPLES or float(np.median(np.diff(signal.t_s))) > MAX_INTERVAL_S:
        return False
    near, far = (estimate_noise([finite], (3,), stride=stride) for stride in (1, 2))
    return near > MIN_NOISE * estimate_resolution(finite, float(np.ptp(finite))) and near > MIN_WHITENESS * far


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
                # Lengths first: they are stated, and no response is needed to judge them.
                check_plausible(f"{where}: {name}", float(length), RECORDING[name])
        if len(run.pulses):
            check_plausible(f"{where}/pulses: power_W", float(run.pulses[:, 2].max()), RECORDING["pulses.power_W"])
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
    if len(value) >= MIN_SHAPE_SAMPLES and float((own[:, 1] * own[:, 2]).sum()) > 0.0:
        pulses, times_s, values = thin(own, t_s, value)
        stated, ratio = _compare(name, pixel, pulses, times_s, values)
        likely = _find_time_units(name, pixel, pulses, times_s, values, stated)
        if likely is not None:
            quantity = likely.quantity.format(signal=name)
            _refuse(f"{where}/{quantity}", "times that do not suit the response", "s", likely.unit)
        if stated > SHAPE_AGREES and ratio > MAX_RATIO:
            _refuse_size(f"{where}/{name}", f"a response {ratio:.3g} times too large", ratio, UNITS[name])
        # The size of a response says nothing about units while its shape disagrees.
        if stated <= SHAPE_AGREES:
            ratio = None
    if name in CHANGE_SIGNALS:
        median = float(np.median(value))
        change = max(float(value.max()) - median, median - float(value.min()))
        if change > RECORDING[name].high + NOISE_SIGMAS * estimate_noise([value], (1,)):
            check_plausible(f"{where}/{name}", change, RECORDING[name])
    return ratio


def _find_time_units(
    name: str, pixel: Pixel, pulses: FloatArray, t_s: FloatArray, value: FloatArray, stated: float
) -> _TimeUnits | None:
    """Return other units that explain the signal much better than the stated ones, with any clock offset, do."""
    is_long = float(pulses[:, 1].max()) > LONG_PULSE_S
    # Ten other units and 21 offsets are the cost of this check; a match needs none of them.
    if stated >= SHAPE_CERTAIN and not is_long:
        return None
    margin = SHAPE_DISAGREES_LONG if is_long else SHAPE_DISAGREES
    trials = [(_compare_in(unit, name, pixel, pulses, t_s, value), unit) for unit in TIME_UNITS]
    explained, likely = max(trials, key=lambda item: item[0])
    if explained <= SHAPE_AGREES or 1.0 - explained >= margin * (1.0 - stated):
        return None
    # A late clock is a cause to diagnose, and must not be refused as a wrong unit.
    shifted = max(_compare(name, pixel, pulses, t_s - late_s, value)[0] for late_s in CLOCK_OFFSETS_S)
    return likely if 1.0 - explained < margin * (1.0 - shifted) else None


def _check_temperature(where: str, run: Run, t_s: FloatArray, value: FloatArray) -> None:
    """Check the baseline, or the lowest values where there are hardly any samples before the first pulse."""
    first_s = float(run.pulses[:, 0].min()) if len(run.pulses) else np.inf
    before = value[t_s < first_s]
    baseline = float(np.median(before)) if len(before) >= 5 else float(np.quantile(value, 0.02))
    if float(np.median(value)) > RECORDING["absorber_temperature_K"].high:
        _refuse(where, f"{baseline:.6g} in the dark", "K", "mK")
    if baseline > run.ambient_k - AMBIENT_TOLERANCE_K:
        coldest, hottest, noise = float(value.min()), float(value.max()), NOISE_SIGMAS * estimate_noise([value], (1,))
        if coldest < -noise or hottest > RECORDING["absorber_temperature_K"].high + noise:
            worst = coldest if coldest < -noise else hottest
            raise InputError(
                where, worst, f"temperatures above 0 K, up to {RECORDING['absorber_temperature_K'].high:g} K"
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
    check_plausible(f"{where}/{commanded}", float(np.abs(command).max()), RECORDING[f"commands.{angle}"])
    check_plausible(f"{where}/{name}", float(np.abs(value).max()), RECORDING[name])
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


def _refuse(where: str, observed: str, unit: str, likely: str) -> NoReturn:
    raise InputError(where, Unquoted(observed), f"a quantity in {unit}; it is likely in {likely}", "unit")


def _refuse_size(where: str, observed: str, ratio: float, unit: str) -> NoReturn:
    """Refuse values that are too large by this ratio. The unit's prefix is the nearest power of a thousand."""
    step = int(np.clip(round(np.log10(ratio) / 3.0), 1, 3))
    _refuse(where, observed, unit, ("m", "µ", "n")[step - 1] + unit)


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
    scale, gas_s = {
        "absorber_temperature_K": (1.0, 0.0),
        "displacement_m": (0.5 * pixel.kappa_m_per_k, pixel.tau_g_s),
        "force_N": (0.5 * pixel.phi_n_per_k, pixel.tau_g_s),
    }[name]
    return scale * r_k_per_w * pixel.epsilon * compute_template(pulses, t_s, r_k_per_w * pixel.c_j_per_k, gas_s)


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
