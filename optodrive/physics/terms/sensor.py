"""Terms of instruments, between the pixel and its record.

- Sensor lag: the thermometer follows the absorber with a lag and a delay.
- Sensor scale: the thermometer's gain is wrong.
- Ambient drift: the ambient temperature differs from the stated one and changes.
- Clock offset: the clock of one instrument, or of all, is late.
- Time rate: the clock that times the samples of one instrument, or of all, is fast or slow.
- High-pass: an instrument's input is AC coupled.
- Smoothing: a program averages each sample of a signal with those before and after it.
- Run gain: an instrument has another gain in some runs than in the others.
"""

from math import exp, pi

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter, describe_signals
from optodrive.physics.term import (
    SESSION_TIME,
    TIME_S,
    BySignal,
    HeatGainBound,
    Kernels,
    OperatingEnvelope,
    RecordedRun,
    Term,
    TermValues,
    build_signal_parameters,
)

SIGNALS = BySignal._fields[:3]
"""Signals of a pixel."""
SETTLED, MAX_ORDER = 20.0, 4.0
"""Time constants after which a filter has settled; largest order of a filter."""


@array_kernel
def _relax(t_s: FloatArray, value: FloatArray, tau_s: float, out: FloatArray) -> None:
    out[0] = value[0]
    for row in range(1, len(value)):
        h_s = t_s[row] - t_s[row - 1]
        kept = exp(-h_s / tau_s)
        slope = (value[row] - value[row - 1]) / h_s
        lag = slope * tau_s  # of the answer behind a ramp, once it follows
        out[row] = value[row] - lag + (out[row - 1] - value[row - 1] + lag) * kept


def low_pass(t_s: FloatArray, value: FloatArray, tau_s: float) -> FloatArray:
    """Return a signal [n] behind a low-pass of first order that had settled at its first sample.

    t_s: [n], strictly increasing
    """
    out = np.empty(len(value))
    if len(value):
        _relax(np.ascontiguousarray(t_s), np.ascontiguousarray(value), tau_s, out)
    return out


def low_pass_both_ways(t_s: FloatArray, value: FloatArray, tau_s: float, order: float = 1.0) -> FloatArray:
    """Return a signal [n] behind a Butterworth filter that a program ran forwards and backwards over its samples.

    order: of one way; it had settled at both ends
    """
    dt_s = float(np.median(np.diff(t_s)))
    even_s = np.linspace(t_s[0], t_s[-1], round((t_s[-1] - t_s[0]) / dt_s) + 1)
    settled = 1 + int(SETTLED * tau_s / dt_s)
    padded = np.pad(np.interp(even_s, t_s, value), settled, mode="edge")
    ratio = 2.0 * pi * tau_s * np.fft.rfftfreq(len(padded), dt_s)
    passed = np.fft.irfft(np.fft.rfft(padded) / (1.0 + ratio ** (2.0 * order)), len(padded))
    return np.interp(t_s, even_s, passed[settled : settled + len(even_s)])


def moving_mean(t_s: FloatArray, value: FloatArray, width_s: float, late_s: float = 0.0) -> FloatArray:
    """Return the mean [n] over width_s around late_s before each sample, or over the part that the signal covers."""
    if len(value) < 2:
        return value
    steps = np.diff(t_s)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (value[1:] + value[:-1]) * steps)])
    ends = [np.clip(t_s - late_s + side * 0.5 * width_s, t_s[0], t_s[-1]) for side in (-1.0, 1.0)]
    before, after = (_integrate_to(t_s, value, total, end) for end in ends)
    covered_s = ends[1] - ends[0]
    return np.where(covered_s > 1e-12, (after - before) / np.maximum(covered_s, 1e-12), value[0])


def _integrate_to(t_s: FloatArray, value: FloatArray, total: FloatArray, end_s: FloatArray) -> FloatArray:
    """Return the integral from the first sample to each time.

    total: the same to each sample
    """
    row = np.clip(np.searchsorted(t_s, end_s, side="right") - 1, 0, len(t_s) - 2)
    share = (end_s - t_s[row]) / (t_s[row + 1] - t_s[row])
    last = value[row] + share * (value[row + 1] - value[row])
    return np.asarray(total[row] + 0.5 * (value[row] + last) * (end_s - t_s[row]))


def mean_of_samples(t_s: FloatArray, value: FloatArray, width: float, late: float = 0.0) -> FloatArray:
    """Return the mean [n] over samples of this number, around those that are late before each, as a program takes it.

    Missing samples count as on a line between their neighbours. A part of a sample counts by its share.
    """
    steps = np.diff(t_s)
    number = np.append(0, np.cumsum(np.maximum(np.round(steps / np.median(steps)), 1.0).astype(np.int64)))
    every = np.arange(number[-1] + 1.0)
    total = np.concatenate([[0.0], np.cumsum(np.interp(every, number, value))])
    ends = [np.clip(every + 0.5 - late + side * 0.5 * width, 0.0, len(every)) for side in (-1.0, 1.0)]
    before, after = (np.interp(end, np.arange(len(total)), total) for end in ends)
    return np.asarray(((after - before) / np.maximum(ends[1] - ends[0], 1e-12))[number])


@kernel
def sensor_lag_sensor_lag(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add the thermometer's time constant, s."""
    return float(x + v[0])


class SensorLag(Term):
    """time · dT/dt = T_true − T, delayed as a whole by delay_share · time."""

    key = "sensor_lag"
    label = "the thermometer lags"
    parameters = (
        TermParameter(
            "time", "s", 5e-4, 1e-6, 5e-3, "0.05 to 3 ms, camera exposure or detector", starts=(1e-4, 5e-4, 2e-3)
        ),
        TermParameter(
            "delay_share",
            "1",
            0.0,
            0.0,
            1.0,
            "additional delay; 0.73 for the moving mean of an exposure",
            starts=(0.0, 0.7),
            is_shape=True,
        ),
    )
    kernels = Kernels(sensor_lag=sensor_lag_sensor_lag)
    is_fast = True
    cannot_add_heat = True
    signature = "edges of temperature against those of displacement"
    remedy = "record a step of light with a faster detector, or at a shorter exposure."

    def signal_delays(self, values: TermValues) -> BySignal:
        """Return the thermometer's delay."""
        return BySignal(temperature=values["time"] * values["delay_share"])


@kernel
def sensor_scale_sensor_reading(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Apply the gain to the rise and add the offset, K."""
    return float(v[0] * x + v[1])


class SensorScale(Term):
    """gain · θ + offset in place of the rise θ above ambient."""

    key = "sensor_scale"
    label = "the thermometer's scale is wrong"
    parameters = (
        TermParameter("gain", "1", 1.03, 0.85, 1.15, "emissivity taken wrongly by 10 %", neutral=1.0),
        TermParameter("offset", "K", 0.0, -20.0, 20.0, "reading at ambient", neutral=0.0),
    )
    kernels = Kernels(sensor_reading=sensor_scale_sensor_reading)
    cannot_add_heat = True
    signature = "a reference temperature only"

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return the offset alone: a gain acts as R, C and κ together, and no data tells it from them."""
        start = {"gain": 1.0, "offset": 1.0}
        return [Hypothesis(self.key, f"{self.key}: offset", (start,), (self.free("offset"),), is_linear=True)]


DRIFT_SETS = (("offset",), ("offset", "ramp", "bend"), ("offset", "ramp", "bend", "rate"), ("rate",))
"""Sets of parameters that are fitted together, one hypothesis each."""


@kernel
def ambient_drift_sensor_reading(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add an offset, a ramp and a parabola in session time, and a ramp in the run's time."""
    u = c[SESSION_TIME]
    return float(x + v[0] + v[1] * u + v[2] * (1.5 * u * u - 0.5) + v[3] * c[TIME_S])


class AmbientDrift(Term):
    """offset + ramp · u + bend · (3u² − 1)/2 + rate · t, with u the session time from −1 to 1 and t the run's time."""

    key = "ambient_drift"
    label = "the ambient temperature differs from the stated one"
    parameters = (
        TermParameter("offset", "K", 0.5, -10.0, 10.0, "ambient against stated temperature, within 5 K", neutral=0.0),
        TermParameter("ramp", "K", 0.5, -10.0, 10.0, "over the recording, within 5 K", neutral=0.0),
        TermParameter("bend", "K", 0.2, -10.0, 10.0, "a parabola over the recording", neutral=0.0),
        TermParameter("rate", "K/s", 0.05, -10.0, 10.0, "within a run", neutral=0.0),
    )
    kernels = Kernels(sensor_reading=ambient_drift_sensor_reading)
    varies_between_runs = True
    signature = "baselines before the pulse"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the largest excess of the ambient over the stated temperature as a rise of everything."""
        return HeatGainBound(uniform_rise_k=abs(values["offset"]) + abs(values["ramp"]) + abs(values["bend"]))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one linear hypothesis per set of `DRIFT_SETS`, started at 1 in each of its parameters."""
        zero = {item.name: 0.0 for item in self.parameters}
        return [
            Hypothesis(
                self.key,
                f"{self.key}: {names[-1]}",
                tuple(zero | {name: 1.0} for name in names),
                tuple(self.free(name) for name in names),
                is_linear=True,
            )
            for names in DRIFT_SETS
        ]


class ClockOffset(Term):
    """A constant delay of each instrument's time axis."""

    key = "clock_offset"
    label = "an instrument's clock is offset"
    parameters = build_signal_parameters("s", 1e-4, -5e-3, 5e-3, "0.05 to 3 ms in either direction")
    starts_by_signal = (2e-4,)
    is_linear = True
    cannot_add_heat = True
    is_exact = True
    subsystems = ("pixels", "mirrors")
    signature = "every edge, in proportion to the slope"
    remedy = "trigger the instrument by the light itself, and record again."

    def signal_delays(self, values: TermValues) -> BySignal:
        """Return the offsets of the four clocks."""
        return BySignal(**values)


class TimeRate(Term):
    """Stated time = (1 + rate) · true time since the start of the run, for each instrument."""

    key = "time_rate"
    label = "an instrument's time axis has a wrong rate"
    parameters = build_signal_parameters("1", 2e-3, -0.05, 0.05, "nominal sampling rates, within 2 %")
    starts_by_signal = (2e-3, 1e-2, -1e-2)  # edges late in a train move by more than their width at the large ones
    is_linear = True
    cannot_add_heat = True
    is_exact = True
    subsystems = ("pixels", "mirrors")
    signature = "edges, the later in a run the further off"
    remedy = "time the samples by a second clock; late edges of a pixel or a laser do not move with it."

    def signal_rates(self, values: TermValues) -> BySignal:
        """Return the rates of the four clocks."""
        return BySignal(**values)


class HighPass(Term):
    """dy/dt = dx/dt − 2π · cut-off frequency · y, with x the signal and y its record."""

    key = "high_pass"
    label = "an instrument's input is AC coupled"
    parameters = build_signal_parameters(
        "Hz", 0.3, 0.0, 30.0, "AC inputs of oscilloscopes and amplifiers, 0.1 to 10 Hz", SIGNALS
    )
    starts_by_signal = (0.03, 0.3, 3.0)
    cannot_add_heat = True
    only_records = True
    signature = "a signal that falls while the drive is held, and undershoots after it"
    removes_zero = True
    twin = "gas_leak"
    remedy = "couple the input DC, state coupling = DC in the runs and record again: what remains is the pixel."

    def record(
        self, values: TermValues, signal: str, t_s: FloatArray, value: FloatArray, run: RecordedRun
    ) -> FloatArray:
        """Return the signal behind the high-pass, [n]."""
        cutoff_hz = values.get(signal, 0.0)
        return value if cutoff_hz <= 0.0 else value - low_pass(t_s, value, 1.0 / (2.0 * pi * cutoff_hz))


SMOOTHING_STARTS_S = (1e-3, 5e-3, 2e-2)
SMOOTHING_FORMS = (
    *((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (3.0, 0.0, 0.0)),
    *((0.0, 0.5, 0.0), (0.0, 0.0, 1.0), (0.0, 0.5, 1.0)),
)
"""Order, lateness and whether the width is in samples, from which a search begins."""
SAME_SPREAD = 24.0**-0.5
"""Time constant of a filter run both ways that spreads an edge as far as a moving mean of unit width."""
UNIT_INTERVAL_S = 1e-3


class Smoothing(Term):
    """A moving mean over the width, or from order = 1 on a low-pass run both ways as wide, late by late · width.

    With by_samples = 1, the width is that at one sample per millisecond, and a mean over as many samples elsewhere.
    """

    key = "smoothing"
    label = "a signal was smoothed before it was recorded"
    parameters = (
        *build_signal_parameters("s", 5e-3, 0.0, 0.1, "moving means and filters of loggers, to 50 ms", SIGNALS),
        TermParameter(
            "order", "1", 0.0, 0.0, MAX_ORDER, "0 moving mean, from 1 on filter run both ways", (0.0, 1.0), True
        ),
        TermParameter("late", "1", 0.0, 0.0, 0.5, "0 centred, 0.5 mean of the last samples", (0.0, 0.5), True),
        TermParameter("by_samples", "1", 0.0, 0.0, 1.0, "0 width in time, 1 in samples", (0.0, 1.0), True),
    )
    cannot_add_heat = True
    only_records = True
    is_fast = True
    signature = "edges that begin before the light does, or are rounded in one signal alone"
    remedy = "record again without averaging or filter."

    def record(
        self, values: TermValues, signal: str, t_s: FloatArray, value: FloatArray, run: RecordedRun
    ) -> FloatArray:
        """Return the smoothed signal, [n]."""
        width_s, order, late = values.get(signal, 0.0), values["order"], values["late"]
        if width_s <= 0.0 or len(t_s) < 2:
            return value
        mean = value
        if values["by_samples"] > 0.5:
            width = max(width_s / UNIT_INTERVAL_S, 1.0)
            mean = mean_of_samples(t_s, value, width, late * width) if order < 1.0 else value
            width_s *= float(np.median(np.diff(t_s))) / UNIT_INTERVAL_S
        elif order < 1.0:
            mean = moving_mean(t_s, value, width_s, late * width_s)
        if order <= 0.0:
            return mean
        filtered = low_pass_both_ways(t_s, value, SAME_SPREAD * width_s, max(order, 1.0))
        both = np.interp(t_s - late * width_s, t_s, filtered)
        return np.asarray(mean + min(order, 1.0) * (both - mean))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one width for all signals, and one of each signal alone where there are several."""
        return [
            Hypothesis(
                self.key,
                f"{self.key} of {describe_signals(names)}",
                tuple(
                    dict.fromkeys(SIGNALS, 0.0) | dict.fromkeys(names, width_s) | form
                    for width_s in SMOOTHING_STARTS_S
                    for form in (
                        dict(zip(("order", "late", "by_samples"), numbers, strict=True)) for numbers in SMOOTHING_FORMS
                    )
                ),
                (self.free(*names), self.free("order"), self.free("late")),
            )
            for names in scope.list_signal_sets(SIGNALS)
        ]


GAIN_START = 0.05
BESIDE_RUN = 1e-6
"""Session time beside a run, far less than between two."""
MAX_POWERS = 4
"""Largest number of powers whose order gains may have by chance: that of k powers is one of k! orders."""


class RunGain(Term):
    """(1 + gain) · signal in runs that start from `first` to `last`, in session time from −1 to 1.

    With by_power = 1 it is (1 + gain · (1 − power)) · signal, with the largest power of the run relative to full power.
    """

    key = "run_gain"
    label = "the gain of an instrument, or the power of the laser, is another in some runs"
    parameters = (
        *build_signal_parameters("1", GAIN_START, -0.5, 0.5, "a range, a lens or a sensor exchanged, to 30 %", SIGNALS),
        TermParameter(
            "first", "1", -1.0, -1.0 - BESIDE_RUN, 1.0 + BESIDE_RUN, "session time of the first run", (), True
        ),
        TermParameter("last", "1", 1.0, -1.0 - BESIDE_RUN, 1.0 + BESIDE_RUN, "session time of the last run", (), True),
        TermParameter("by_power", "1", 0.0, 0.0, 1.0, "1: the gain follows the power by chance", (), True),
    )
    cannot_add_heat = True
    is_exact = True
    only_records = True
    varies_between_runs = True
    signature = "one scale of a signal in some runs, and another in their repeats"
    remedy = (
        "with sensors and laser untouched, record one power again before, between and after the others; a gain that "
        "changed shows in these repeats, and no power that is wrong does."
    )

    def record(
        self, values: TermValues, signal: str, t_s: FloatArray, value: FloatArray, run: RecordedRun
    ) -> FloatArray:
        """Return the signal with the gain of its run, [n]."""
        if not values["first"] <= run.session_time <= values["last"]:
            return value
        share = 1.0 - run.power if values["by_power"] > 0.5 else 1.0
        return value * (1.0 + share * values.get(signal, 0.0))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one gain of each signal, in a run, in a group of runs, or from a run on, and of all signals likewise.

        From a run on, all signals together change as the absorber does that loses some of its absorption. Where the
        powers are few, the gains of one signal may follow them by chance.
        """
        none = dict.fromkeys(SIGNALS, 0.0) | {item.name: item.default for item in self.parameters[3:]}
        hypotheses = []
        for names in scope.list_signal_sets(SIGNALS):
            is_alone = len(names) == 1 or len(scope.signals) == 1
            spans = scope.list_run_spans(with_steps=is_alone)
            start, label = none | dict.fromkeys(names, GAIN_START), f"{self.key} of {describe_signals(names)}"
            starts = tuple(start | {"first": first - BESIDE_RUN, "last": last + BESIDE_RUN} for first, last in spans)
            hypotheses += [Hypothesis(self.key, label, starts, (self.free(*names),), True)] if starts else []
            if is_alone and 1 < scope.power_levels <= MAX_POWERS:
                starts = (start | {"by_power": 1.0},)
                hypotheses.append(Hypothesis(self.key, f"{label} by power", starts, (self.free(*names),), True))
        return hypotheses
