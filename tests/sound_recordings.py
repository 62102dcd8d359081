"""Random sound recordings, and copies of them with one quantity in a wrong unit."""

from dataclasses import replace

import numpy as np

from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.device.servo import Servo, simulate_servo
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.terms import discover_terms

NAMES = ("absorber_temperature_K", "displacement_m", "force_N")
NOISE = (1.0, 0.5e-6, 0.2e-3)
"""Noise of the instruments, K, m, N."""
HIDDEN = sorted(key for key, term in discover_terms().items() if term.in_pixel and "pixels" in term.subsystems)


def sound_recording(rng):
    """Return a recording of one pixel: powers, widths and trains, perhaps a neighbour, a dead pixel or mirrors."""
    pixel = Pixel(
        float(rng.uniform(95, 382)),
        float(rng.uniform(80e-6, 130e-6)),
        0.66,
        float(10 ** rng.uniform(-3.0, -2.2)),
        float(10 ** rng.uniform(-5.7, -5.0)),
        float(10 ** rng.uniform(-4.0, -3.2)),
    )
    ambient_k, terms = float(rng.uniform(283, 303)), _draw_terms(rng)
    kinds = [kind for kind in range(3) if rng.random() < 0.6] or [int(rng.integers(3))]
    gain = 0.0 if rng.random() < 0.05 else float(rng.uniform(0.5, 1.5))
    rate_hz, noise = float(10 ** rng.uniform(2.7, 4.0)), float(10 ** rng.uniform(-1.0, 0.5))
    runs = [
        _record_run(rng, f"run{number}", pixel, ambient_k, terms, kinds, gain, rate_hz, noise)
        for number in range(int(rng.integers(2, 6)))
    ]
    if rng.random() < 0.3:
        runs.append(_record_mirrors(rng, len(runs), ambient_k))
    if rng.random() < 0.7:
        width_m = float(rng.uniform(0.2e-3, 0.75e-3))
        runs = [replace(run, attributes=run.attributes | {"bridge_width_m": width_m}) for run in runs]
    return Measurement(tuple(runs))


def _draw_terms(rng):
    if rng.random() < 0.4:
        return {}
    term = discover_terms()[HIDDEN[int(rng.integers(len(HIDDEN)))]]
    values = {item.name: float(rng.uniform(0.5, 1.5)) * item.default for item in term.parameters}
    return {term.key: {i.name: float(np.clip(values[i.name], i.low, i.high)) for i in term.parameters}}


def _record_run(rng, name, pixel, ambient_k, terms, kinds, gain, rate_hz, noise):
    pulses = _draw_pulses(rng)
    until_s = float((pulses[:, 0] + pulses[:, 1]).max()) + float(rng.uniform(0.05, 0.3))
    t_s = np.arange(0.5 / rate_hz, until_s, 1.0 / rate_hz)[:20_000]
    experiment = PixelExperiment(pulses, 0, ambient_k, (t_s, t_s, t_s))
    exact = simulate_signals(experiment, pixel, ActiveTerms.from_values(terms))
    signals = {}
    for kind in kinds:
        value = gain * exact[kind] + noise * NOISE[kind] * rng.standard_normal(len(t_s)) + (0.0, 0.0, 1e-3)[kind]
        value[rng.random(len(t_s)) < 0.01] = np.nan
        value += ambient_k if kind == 0 else 0.0
        signals[NAMES[kind]] = Signal(0, t_s, value, noise * NOISE[kind] if rng.random() < 0.5 else None)
    return Run(name, ambient_k, pulses, signals, {"group": name})


def _draw_pulses(rng):
    target, power_w = 0.0 if rng.random() < 0.85 else 1.0, float(rng.uniform(0.3, 2.45))
    if rng.random() < 0.3:
        width_s, period_s = float(rng.uniform(2e-3, 20e-3)), float(rng.uniform(0.025, 0.1))
        starts = 0.02 + period_s * np.arange(int(rng.integers(3, 30)))
    else:
        width_s, starts = float(10 ** rng.uniform(-2.5, -1.2)), np.array([float(rng.uniform(0.01, 0.03))])
    return np.column_stack([starts, 0 * starts + width_s, 0 * starts + power_w, 0 * starts + target])


def _record_mirrors(rng, number, ambient_k):
    t_s = np.arange(0.0, 0.05, float(10 ** rng.uniform(-5.0, -4.0)))
    commands = np.column_stack([np.arange(10) * 5e-3, *(rng.uniform(-0.15, 0.15, (2, 10)))])
    servo = Servo(frequency=float(rng.uniform(400, 3000)), damping=0.7, delay=3e-5, slew=150.0)
    signals = {}
    for column, name in ((1, "mirror_x_rad"), (2, "mirror_y_rad")):
        value = simulate_servo(commands[:, 0], commands[:, column], t_s, servo)
        signals[name] = Signal(0, t_s, value + 1e-5 * rng.standard_normal(len(t_s)))
    return Run(f"run{number}", ambient_k, np.zeros((0, 4)), signals, {}, commands)


def _signals(run, change, *names):
    return {name: change(signal) if name in names else signal for name, signal in run.signals.items()}


def _scale_value(name, factor, offset=0.0):
    def change(run):
        def scale(signal):
            sigma = None if signal.sigma is None else signal.sigma * factor
            return replace(signal, value=signal.value * factor + offset, sigma=sigma)

        return replace(run, signals=_signals(run, scale, name))

    return change


def _scale_times(name, factor):
    return lambda run: replace(run, signals=_signals(run, lambda s: replace(s, t_s=s.t_s * factor), name))


def _scale_pulses(*factors):
    return lambda run: replace(run, pulses=run.pulses * [*factors, 1.0])


def _scale_commands(*factors):
    return lambda run: run if run.commands is None else replace(run, commands=run.commands * factors)


def _scale_all_times(factor):
    def change(run):
        commands = None if run.commands is None else run.commands * [factor, 1.0, 1.0]
        signals = _signals(run, lambda signal: replace(signal, t_s=signal.t_s * factor), *run.signals)
        return replace(run, pulses=run.pulses * [factor, factor, 1.0, 1.0], signals=signals, commands=commands)

    return change


def _scale_width(factor):
    def change(run):
        attributes = {
            key: value * factor if key == "bridge_width_m" else value for key, value in run.attributes.items()
        }
        return replace(run, attributes=attributes)

    return change


def _scale_ambient(run):
    return replace(run, ambient_k=run.ambient_k - 273.15)


DEGREES = 180.0 / np.pi
WRONG_UNITS = {
    ("absorber_temperature_K", "°C"): _scale_value(NAMES[0], 1.0, -273.15),
    ("absorber_temperature_K", "mK"): _scale_value(NAMES[0], 1e3),
    ("displacement_m", "mm"): _scale_value(NAMES[1], 1e3),
    ("displacement_m", "µm"): _scale_value(NAMES[1], 1e6),
    ("force_N", "mN"): _scale_value(NAMES[2], 1e3),
    ("power_W", "mW"): _scale_pulses(1.0, 1.0, 1e3),
    ("width_s", "ms"): _scale_pulses(1.0, 1e3, 1.0),
    ("start_s", "ms"): _scale_pulses(1e3, 1.0, 1.0),
    ("start_s and width_s", "ms"): _scale_pulses(1e3, 1e3, 1.0),
    ("start_s, width_s", "µs"): _scale_pulses(1e6, 1e6, 1.0),
    ("t_s", "ms"): _scale_all_times(1e3),
    ("absorber_temperature_K/t_s", "ms"): _scale_times(NAMES[0], 1e3),
    ("displacement_m/t_s", "ms"): _scale_times(NAMES[1], 1e3),
    ("displacement_m/t_s", "µs"): _scale_times(NAMES[1], 1e6),
    ("mirror_x_rad", "degrees"): _scale_value("mirror_x_rad", DEGREES),
    ("mirror_x_rad/t_s", "ms"): _scale_times("mirror_x_rad", 1e3),
    ("commands: x_rad", "degrees"): _scale_commands(1.0, DEGREES, 1.0),
    ("commands: t_s", "ms"): _scale_commands(1e3, 1.0, 1.0),
    ("bridge_width_m", "mm"): _scale_width(1e3),
    ("bridge_width_m", "µm"): _scale_width(1e6),
    ("ambient_K", "°C"): _scale_ambient,
}
"""Quantity and unit to a change of one run."""


def mistake_units(rng, measurement):
    """Return the recording with a quantity of one run, or of all, in a wrong unit, then the quantity and the unit.

    None where no quantity of the recording shows it, as without a pulse on the measured pixel.
    """
    keys = list(WRONG_UNITS)
    for index in rng.permutation(len(keys)):
        quantity, unit = keys[index]
        change = WRONG_UNITS[quantity, unit]
        chosen = [int(rng.integers(len(measurement.runs)))] if rng.random() < 0.5 else range(len(measurement.runs))
        if not any(_shows(measurement.runs[row], quantity) for row in chosen):
            continue
        runs = [change(run) if row in chosen else run for row, run in enumerate(measurement.runs)]
        return Measurement(tuple(runs)), quantity, unit
    return None


def _shows(run, quantity):
    """Return whether a wrong unit of the quantity can be seen in a run: the signal is there and responds."""
    if quantity == "bridge_width_m":
        return quantity in run.attributes
    if "mirror" in quantity or "commands" in quantity:
        return run.commands is not None
    name = quantity.removesuffix("/t_s")
    if name in NAMES and name not in run.signals:
        return False
    if quantity == "ambient_K":
        return True
    if quantity in ("absorber_temperature_K", "power_W"):
        return len(run.pulses) > 0 if quantity == "power_W" else True
    if run.commands is not None:
        return quantity == "t_s"
    if run.pulses[0, 3] != 0.0:
        return False
    names = [name] if name in NAMES else list(run.signals)
    sizes = dict(zip(NAMES, NOISE, strict=True))
    spans = {key: np.ptp(np.nanquantile(run.signals[key].value, [0.01, 0.99])) for key in names}
    return any(span > 10.0 * sizes[key] for key, span in spans.items())
