"""Faults of instruments and loggers, each with its own electronics, drawn at a size by the session's scales."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from zoneinfo import ZoneInfo

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, filtfilt, lfilter

from blind_display import DISPLACEMENT, FORCE, MIRRORS, TEMPERATURE, Physics, simulate_signals
from blind_lab import Case
from blind_noise import NoiseColour
from blind_session import Run

Rng = np.random.Generator


@dataclass
class Trace:
    """One signal of one run as its logger stores it."""

    t_s: np.ndarray
    value: np.ndarray


@dataclass(frozen=True)
class Channel:
    """One signal of one run on its way to the file: stamps, and random numbers of its own."""

    rng: Rng
    run: Run
    name: str
    t_s: np.ndarray


@dataclass
class Session:
    """Samples of all runs, and the text of their start times."""

    traces: dict[str, dict[str, Trace]]
    stamps: dict[str, object]


@dataclass(frozen=True)
class Fault:
    """One fault of an instrument or a logger. Its hooks act in the order in which they are listed.

    runs: names of the affected runs, empty for all; instants: true instants of the samples, and their stamps;
    analogue: values of the sensor to values; digital: noisy samples to samples; files: acts on the whole session
    """

    kind: str
    form: str
    signals: tuple[str, ...]
    runs: tuple[str, ...] = ()
    sizes: dict[str, float] = field(default_factory=dict)
    is_ambiguous: bool = False  # nobody can read it without asking
    instants: Callable[[Channel], tuple[np.ndarray, np.ndarray]] | None = None
    analogue: Callable[[Channel, np.ndarray], np.ndarray] | None = None
    digital: Callable[[Channel, np.ndarray], np.ndarray] | None = None
    files: Callable[[Rng, Session], None] | None = None

    def touches(self, run: Run, signal: str) -> bool:
        """Return whether it acts on this signal of this run."""
        return signal in self.signals and (not self.runs or run.name in self.runs)


@dataclass(frozen=True)
class Scales:
    """Range and noise of each signal of a session, by which the sizes of faults are drawn."""

    case: Case
    low: dict[str, float]
    high: dict[str, float]
    white: dict[str, float]
    signals: tuple[str, ...]
    runs: tuple[Run, ...]  # those of pixels

    def pick_signal(self, rng: Rng, *, no_temperature: bool = False) -> str:
        return str(rng.choice([s for s in self.signals if not (no_temperature and s == TEMPERATURE)]))

    def pick_runs(self, rng: Rng, signals: tuple[str, ...], low: int, high: int) -> tuple[str, ...]:
        """Return the names of some runs that show one of the signals."""
        able = [r.name for r in self.runs if set(signals) & set(r.shown)]
        count = min(int(rng.integers(low, high + 1)), len(able))
        return tuple(sorted(str(name) for name in rng.choice(able, count, replace=False)))

    def pick_some(self, rng: Rng) -> tuple[str, ...]:
        """Return one of the signals, or all of them."""
        return self.signals if rng.random() < 0.35 else (self.pick_signal(rng),)


def measure_scales(case: Case) -> Scales:
    """Return the scales of a case's session."""
    low, high = {}, {}
    runs = tuple(r for r in case.runs if set(r.shown) & {TEMPERATURE, DISPLACEMENT, FORCE})
    for run in runs:
        for name, value in simulate_run(case.truth, run, {n: run.experiment.times[n] for n in run.shown}).items():
            low[name] = min(low.get(name, np.inf), float(value.min()))
            high[name] = max(high.get(name, -np.inf), float(value.max()))
    white = {name: colour.white for name, colour in case.instruments.colours.items()}
    signals = tuple(n for n in (TEMPERATURE, DISPLACEMENT, FORCE) if n in low)
    return Scales(case, low, high, white, signals, runs)


def simulate_run(truth: Physics, run: Run, times: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the readings of ideal instruments in a run, at its actual conditions."""
    return simulate_signals(
        truth,
        run.experiment.pulses,
        times,
        pixel=run.experiment.pixel,
        ambient_k=run.ambient_k,
        session_s=run.session_s,
        dose_j=run.dose_j,
        noise_seed=run.noise_seed,
        factor=run.power,
        late_s=run.late_s,
        commands=run.experiment.commands,
    )


def _log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _pick(rng: Rng, *forms: str) -> str:
    return str(rng.choice(list(forms)))


def _fill(t_s: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return values with straight lines across missing samples: a filter has no missing ones."""
    there = np.isfinite(value)
    return np.interp(t_s, t_s[there], value[there])


def _draw_flat(rng: Rng, scales: Scales) -> Fault:
    """Draw a loose cable in one to three runs."""
    signals = scales.pick_some(rng)
    form = _pick(rng, "noise", "noise", "stuck", "loud")

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        rest, name = float(value[np.isfinite(value)][0]), at.name
        if form == "stuck":
            return np.full(len(value), rest + at.rng.uniform(0.0, 0.5) * (scales.high[name] - scales.low[name]))
        return rest + (10.0 if form == "loud" else 1.0) * scales.white[name] * at.rng.standard_normal(len(value))

    return Fault("flat", form, signals, scales.pick_runs(rng, signals, 1, 3), digital=digital)


def _draw_ceiling(rng: Rng, scales: Scales) -> Fault:
    """Draw the end of an instrument's range, above or below: of its converter, of its sensor, or with a knee."""
    name, form = scales.pick_signal(rng), _pick(rng, "converter", "converter", "sensor", "knee")
    share, side = float(rng.uniform(0.5, 0.95)), 1.0 if rng.random() < 0.75 else -1.0
    low, high = scales.low[name], scales.high[name]
    at = low + share * (high - low) if side > 0 else high - share * (high - low)
    width = 0.0 if form != "knee" else float(rng.uniform(0.02, 0.06)) * (high - low)

    def clip(_: Channel, value: np.ndarray) -> np.ndarray:
        over = side * (value - at)
        if width:
            over = -width * np.logaddexp(0.0, -over / width)
        return at + side * np.minimum(over, 0.0)

    sizes = {"share": share, "side": side, "at": at}
    if form == "converter":
        return Fault("ceiling", form, (name,), sizes=sizes, digital=clip)
    return Fault("ceiling", form, (name,), sizes=sizes, analogue=clip)


def _draw_time_rate(rng: Rng, scales: Scales) -> Fault:
    """Draw a converter that is faster or slower than its sheet says: of all signals or of one."""
    every = rng.random() < 0.6
    signals = (*scales.signals, *MIRRORS) if every else (scales.pick_signal(rng),)
    rate = _sign(rng) * float(rng.uniform(0.005, 0.012))
    return Fault(
        "time_rate",
        "all" if every else "one",
        signals,
        sizes={"rate": rate},
        instants=lambda at: (at.t_s * (1.0 + rate), at.t_s),
    )


def _draw_moving_mean(rng: Rng, scales: Scales) -> Fault:
    """Draw a mean of n samples, of the last ones or around each."""
    name, form, count = scales.pick_signal(rng), _pick(rng, "trailing", "centred"), 2 * int(rng.integers(3, 16)) + 1

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        shift = (count - 1) // 2 if form == "trailing" else 0
        mean = uniform_filter1d(_fill(at.t_s, value), count, mode="nearest", origin=shift)
        return np.where(np.isfinite(value), mean, np.nan)

    return Fault("moving_mean", form, (name,), sizes={"samples": count}, digital=digital)


def _draw_zero_phase(rng: Rng, scales: Scales) -> Fault:
    """Draw a low-pass that was run forward and backward."""
    name, order, hz = scales.pick_signal(rng), int(rng.integers(1, 5)), _log(rng, 20.0, 150.0)

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        rate = (len(at.t_s) - 1) / float(at.t_s[-1] - at.t_s[0])
        b, a = butter(order, min(hz, 0.4 * rate), fs=rate)
        return np.where(np.isfinite(value), filtfilt(b, a, _fill(at.t_s, value)), np.nan)

    return Fault("zero_phase", f"order_{order}", (name,), sizes={"hz": hz}, digital=digital)


def _draw_hold(rng: Rng, scales: Scales) -> Fault:
    """Draw a slow channel whose values a logger repeats or interpolates at the rate of the others."""
    name, form, hz = scales.pick_signal(rng), _pick(rng, "hold", "linear"), float(rng.choice([60.0, 100.0, 100.0]))

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        first_s, count = float(at.t_s[0]) + at.rng.uniform(-0.5, 0.5) / hz, int((at.t_s[-1] - at.t_s[0]) * hz) + 3
        slow_s = first_s + np.arange(-1, count) / hz
        full = _fill(at.t_s, value)
        slow = full[np.clip(np.searchsorted(at.t_s, slow_s), 0, len(at.t_s) - 1)]
        if form == "linear":
            return np.interp(at.t_s, slow_s, slow)
        return slow[np.searchsorted(slow_s, at.t_s, side="right") - 1]

    return Fault("hold", form, (name,), sizes={"hz": hz}, digital=digital)


def _draw_high_pass(rng: Rng, scales: Scales) -> Fault:
    """Draw an amplifier that is coupled by a capacitor."""
    name, hz = scales.pick_signal(rng, no_temperature=True), _log(rng, 0.3, 3.0)

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        full = _fill(at.t_s, value)
        ratio = 1.0 / (1.0 + 2.0 * np.pi * hz * float(at.t_s[-1] - at.t_s[0]) / (len(at.t_s) - 1))
        passed = lfilter([ratio, -ratio], [1.0, -ratio], full - np.median(full[:5]))
        return np.where(np.isfinite(value), passed, np.nan)

    return Fault("high_pass", "first_order", (name,), sizes={"hz": hz}, digital=digital)


def _draw_signal_clock(rng: Rng, scales: Scales) -> Fault:
    """Draw one signal whose clock alone is late, or early."""
    name, late_s = scales.pick_signal(rng), _log(rng, 5e-4, 3e-3) * (1.0 if rng.random() < 0.8 else -1.0)
    return Fault(
        "signal_clock",
        "late" if late_s > 0 else "early",
        (name,),
        sizes={"late_s": late_s},
        instants=lambda at: (at.t_s - late_s, at.t_s),
    )


def _draw_outliers(rng: Rng, scales: Scales) -> Fault:
    """Draw single samples far off: one to five in all, or one in 10,000."""
    form, name = _pick(rng, "few", "few", "rare"), scales.pick_signal(rng)
    able = [run for run in scales.runs if name in run.shown]
    total = sum(len(run.experiment.times[name]) for run in able)
    count = int(rng.integers(1, 6)) if form == "few" else max(1, rng.poisson(total / 1e4))
    hit: dict[str, list[tuple[float, float]]] = {}
    for _ in range(count):
        run = able[int(rng.integers(len(able)))]
        hit.setdefault(run.name, []).append((float(rng.uniform()), _sign(rng) * _log(rng, 8.0, 60.0)))

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        value, there = value.copy(), np.flatnonzero(np.isfinite(value))
        for place, size in hit[at.run.name]:
            value[there[int(place * len(there))]] += size * scales.white[name]
        return value

    sizes = {"count": count, "largest_sigma": max(abs(s) for some in hit.values() for _, s in some)}
    return Fault("outliers", form, (name,), tuple(sorted(hit)), sizes, digital=digital)


def _draw_slow_drift(rng: Rng, scales: Scales) -> Fault:
    """Draw a zero that wanders within each run, with or without hum of the mains."""
    name, form = scales.pick_signal(rng), _pick(rng, "walk", "linear", "walk_and_hum")
    size, hum = _log(rng, 0.7, 4.0) * scales.white[name], _log(rng, 0.3, 2.0) * scales.white[name]

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        steps = at.rng.standard_normal(len(at.t_s)) / np.sqrt(len(at.t_s))
        wander = size * np.cumsum(steps)
        if form == "linear":
            wander = size * at.rng.standard_normal() * (at.t_s - at.t_s[0]) / (at.t_s[-1] - at.t_s[0])
        if form == "walk_and_hum":
            wander = wander + hum * np.sin(2.0 * np.pi * 50.0 * at.t_s + at.rng.uniform(0.0, 2.0 * np.pi))
        return value + wander

    return Fault("slow_drift", form, (name,), sizes={"sigma": size / scales.white[name]}, digital=digital)


def _draw_quantised(rng: Rng, scales: Scales) -> Fault:
    """Draw a converter with coarse steps."""
    signals, sigma = scales.pick_some(rng), _log(rng, 0.5, 8.0)

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        step = sigma * scales.white[at.name]
        return step * np.round(value / step)

    return Fault("quantised", "round", signals, sizes={"sigma": sigma}, digital=digital)


def _draw_coloured(rng: Rng, scales: Scales) -> Fault:
    """Draw noise with memory, larger than the session's own."""
    signals, form = scales.pick_some(rng), _pick(rng, "one_time", "many_times")
    share = _log(rng, 0.7, 3.0)
    times = [_log(rng, 1e-3, 0.1)] if form == "one_time" else list(np.geomspace(1e-3, 0.3, 6))

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        size, dt = share * scales.white[at.name] / np.sqrt(len(times)), (at.t_s[-1] - at.t_s[0]) / (len(at.t_s) - 1)
        parts = (NoiseColour(0.0, "ou", ((size, tau), (0.0, 1.0))).sample(at.rng, len(at.t_s), dt) for tau in times)
        return value + sum(parts)

    return Fault("coloured", form, signals, sizes={"sigma": share}, digital=digital)


def _draw_free_running(rng: Rng, scales: Scales) -> Fault:
    """Draw sensors that run freely: each run begins at another phase, and rates differ a little."""
    signals = scales.pick_some(rng)

    def instants(at: Channel) -> tuple[np.ndarray, np.ndarray]:
        dt = float(at.t_s[-1] - at.t_s[0]) / (len(at.t_s) - 1)
        t_s = (np.arange(len(at.t_s)) + at.rng.uniform(0.02, 0.98)) * dt * (1.0 + 1e-3 * at.rng.standard_normal())
        return t_s, t_s

    return Fault("free_running", "phase", signals, instants=instants)


def _count_excel_days(moment: datetime) -> float:
    return (moment - datetime(1899, 12, 30, tzinfo=UTC)).total_seconds() / 86400.0


STAMPS: dict[str, Callable[[datetime], object]] = {
    "iso_space": lambda at: at.strftime("%Y-%m-%d %H:%M:%S"),
    "iso_z": lambda at: at.strftime("%Y-%m-%dT%H:%M:%SZ"),
    "iso_compact": lambda at: at.strftime("%Y%m%dT%H%M%SZ"),
    "no_colon": lambda at: at.strftime("%Y-%m-%dT%H:%M:%S+0000"),
    "slashes": lambda at: at.strftime("%Y/%m/%d %H:%M:%S"),
    "german": lambda at: at.strftime("%d.%m.%Y %H:%M:%S"),
    "mail": format_datetime,
    "minutes": lambda at: at.strftime("%Y-%m-%d %H:%M"),
    "zones": lambda at: at.astimezone(ZoneInfo(("UTC", "Europe/Berlin")[at.second % 2])).isoformat(),
    "american": lambda at: at.strftime("%m/%d/%Y %I:%M:%S %p"),
    "british": lambda at: at.strftime("%d/%m/%Y %H:%M:%S"),
    "autumn": lambda at: at.astimezone(ZoneInfo("Europe/Berlin")).strftime("%Y-%m-%dT%H:%M:%S"),
    "unix": lambda at: at.timestamp(),
    "unix_text": lambda at: f"{at.timestamp():.3f}",
    "excel": lambda at: f"{_count_excel_days(at):.6f}",
    "labview": lambda at: (at - datetime(1904, 1, 1, tzinfo=UTC)).total_seconds(),
    "clock_only": lambda at: at.strftime("%H:%M:%S"),
}
"""Start times as spreadsheets and loggers write them. From `american` on, nobody can read them without a question."""


def _draw_stamps(rng: Rng, scales: Scales) -> Fault:
    """Draw the form of the start times; days and months that could be each other, and autumn's hour."""
    form = _pick(rng, *STAMPS)
    start = datetime(2025, 1 + int(rng.integers(12)), 1 + int(rng.integers(12)), 9, 7, tzinfo=UTC)
    if form == "autumn":  # the clock goes from 3:00 to 2:00 at 1:00 UTC, in the middle of the session
        start = datetime(2025, 10, 26, 1, 0, tzinfo=UTC) - timedelta(seconds=0.5 * scales.case.runs[-1].session_s)
    is_unclear = list(STAMPS).index(form) >= list(STAMPS).index("american")
    if form in ("american", "british") and rng.random() < 0.4:  # past midnight into a day that is no month
        start, is_unclear = start.replace(day=12, hour=23, minute=58), False

    def files(_: Rng, session: Session) -> None:
        for run in scales.case.runs:
            session.stamps[run.name] = STAMPS[form](start + timedelta(seconds=run.session_s))

    return Fault("stamps", form, (), is_ambiguous=is_unclear, files=files)


def _draw_sentinel(rng: Rng, scales: Scales) -> Fault:
    """Draw a number that stands for a missing sample."""
    name = scales.pick_signal(rng)
    number = float(rng.choice([-9999.0, 999.0, 9.9e37, *([0.0, -273.15] if name == TEMPERATURE else [])]))
    share, runs = _log(rng, 1e-3, 0.03), scales.pick_runs(rng, (name,), 1, 30)

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        lost = at.rng.random(len(value)) < share
        lost[int(at.rng.integers(len(value)))] = True
        return np.where(lost, number, value)

    return Fault("sentinel", f"{number:g}", (name,), runs, {"share": share}, digital=digital)


def _draw_exchanged(rng: Rng, scales: Scales) -> Fault:
    """Draw two runs of different experiments whose files have each other's name."""
    able = [r for r in scales.runs if len(r.experiment.pulses) == 1 and r.experiment.pixel == 0]
    able = [r for r in able if r.experiment.pulses[0, 3] == 0]
    pairs = [
        (a, b)
        for a in able
        for b in able
        if a.name < b.name
        and a.shown == b.shown
        and max(abs(np.log(a.experiment.pulses[0, k] / b.experiment.pulses[0, k])) for k in (1, 2)) > 0.25
    ]
    first, second = pairs[int(rng.integers(len(pairs)))]

    def files(_: Rng, session: Session) -> None:
        session.traces[first.name], session.traces[second.name] = (
            session.traces[second.name],
            session.traces[first.name],
        )

    return Fault("exchanged", "two_runs", first.shown, (first.name, second.name), files=files)


def _draw_trigger(rng: Rng, scales: Scales) -> Fault:
    """Draw a trigger that is some 20 ms off in one or two runs."""
    shift_s = _sign(rng) * float(rng.uniform(0.01, 0.03))
    runs = scales.pick_runs(rng, scales.signals, 1, 2)
    return Fault(
        "trigger",
        "late" if shift_s > 0 else "early",
        scales.signals,
        runs,
        {"shift_s": shift_s},
        instants=lambda at: (at.t_s - shift_s, at.t_s),
    )


def _draw_sign(rng: Rng, scales: Scales) -> Fault:
    """Draw an amplifier that is connected the other way round, in the whole session or in one run."""
    name, every = scales.pick_signal(rng, no_temperature=True), rng.random() < 0.5
    runs = () if every else scales.pick_runs(rng, (name,), 1, 1)
    return Fault("sign", "all" if every else "one", (name,), runs, digital=lambda _, value: -value)


def _draw_gain_run(rng: Rng, scales: Scales) -> Fault:
    """Draw another gain in one run."""
    signals, gain = scales.pick_some(rng), 1.0 + _sign(rng) * float(rng.uniform(0.03, 0.08))

    def digital(at: Channel, value: np.ndarray) -> np.ndarray:
        rest = at.run.ambient_k if at.name == TEMPERATURE else 0.0
        return rest + gain * (value - rest)

    return Fault("gain_run", "one_run", signals, scales.pick_runs(rng, signals, 1, 1), {"gain": gain}, digital=digital)


def _draw_gap(rng: Rng, scales: Scales) -> Fault:
    """Draw samples that never reached the file: with a gap in the stamps, or closed up."""
    name, form = scales.pick_signal(rng), _pick(rng, "gap", "closed_up")
    runs = scales.pick_runs(rng, (name,), 1, 3)
    share, count = float(rng.uniform(0.05, 0.4)), int(rng.integers(2, 21))

    def files(own: Rng, session: Session) -> None:
        for run in runs:
            trace = session.traces[run][name]
            size = max(2, int(share * len(trace.t_s))) if form == "gap" else min(count, len(trace.t_s) // 4)
            start = int(own.integers(1, len(trace.t_s) - size))
            trace.value = np.delete(trace.value, np.s_[start : start + size])
            lost = np.s_[start : start + size] if form == "gap" else np.s_[len(trace.t_s) - size :]
            trace.t_s = np.delete(trace.t_s, lost)

    sizes = {"share": share} if form == "gap" else {"samples": float(count)}
    return Fault("gap", form, (name,), runs, sizes, files=files)


FAULTS: dict[str, Callable[[Rng, Scales], Fault]] = {
    "flat": _draw_flat,
    "ceiling": _draw_ceiling,
    "time_rate": _draw_time_rate,
    "moving_mean": _draw_moving_mean,
    "zero_phase": _draw_zero_phase,
    "hold": _draw_hold,
    "high_pass": _draw_high_pass,
    "signal_clock": _draw_signal_clock,
    "outliers": _draw_outliers,
    "slow_drift": _draw_slow_drift,
    "quantised": _draw_quantised,
    "coloured": _draw_coloured,
    "free_running": _draw_free_running,
    "stamps": _draw_stamps,
    "sentinel": _draw_sentinel,
    "exchanged": _draw_exchanged,
    "trigger": _draw_trigger,
    "sign": _draw_sign,
    "gain_run": _draw_gain_run,
    "gap": _draw_gap,
}
