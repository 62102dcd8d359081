"""A lab's session: its design, its instruments and their noise, its runs and its file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

import h5py
import numpy as np

from blind_causes import SessionScale
from blind_display import (
    DISPLACEMENT,
    FORCE,
    FULL_POWER_W,
    MIRRORS,
    TEMPERATURE,
    Physics,
    compute_nominal_rises,
    find_edges,
    simulate_signals,
)
from blind_noise import Bench, BenchRun, NoiseColour, RunVariation, draw_noise_colour

MAX_ABSORBER_K = 700.0
SAMPLES = 1500
# Bridge width, m, and resistance, K/W, of the five samples of Table S3.
SAMPLES_S3 = ((2.0e-4, 382.0), (2.5e-4, 269.0), (4.0e-4, 184.0), (5.5e-4, 145.0), (7.5e-4, 95.0))

Rng = np.random.Generator


@dataclass(frozen=True)
class Experiment:
    """One repeated experiment: its drive and the measured signals."""

    name: str
    pulses: np.ndarray
    times: dict[str, np.ndarray]
    pixel: int = 0
    repeats: int = 2
    commands: np.ndarray | None = None


@dataclass(frozen=True)
class Run:
    """One repeat, with its actual conditions."""

    name: str
    experiment: Experiment
    session_s: float
    dose_j: float
    ambient_k: float
    stated_ambient_k: float
    power: float
    late_s: float
    noise_seed: int
    shown: tuple[str, ...]


@dataclass(frozen=True)
class Instruments:
    """Instruments of a lab and their errors."""

    colours: dict[str, NoiseColour]
    run_variation: RunVariation
    stated: dict[str, float]  # sigma as the instrument's sheet has it
    missing: float
    rates: dict[str, float]
    cooling_rc: float  # in RC
    ambient_k: float
    ambient_amplitude_k: float
    ambient_period_s: float
    start: datetime


def draw_sample_times(rng: Rng, span: float, rate: float) -> np.ndarray:
    """Draw sample times from just after 0 to the end, limited by the memory of the instrument."""
    rate = min(rate, (SAMPLES - 1) / span)
    return (np.arange(int(span * rate)) + rng.uniform(0.05, 0.95)) / rate


def draw_mirror_steps(rng: Rng) -> np.ndarray:
    """Draw steps of three sizes of both mirrors, forth and back. Each falls between two samples at 5 kHz."""
    sizes = [0.004, 0.03, 0.16] * np.exp(0.3 * rng.standard_normal(3))
    rows = [(0.0, 0.0, 0.0)]
    t, x, y = 0.01, 0.0, 0.0
    for size in [*sizes, *(-sizes[::-1])]:
        x += size
        rows.append((t, x, y))
        t += 0.012
        y += size * 0.8
        rows.append((t, x, y))
        t += 0.012
    return np.array(rows)


def draw_base(rng: Rng) -> tuple[Physics, float]:
    """Draw the five parameters of a sample as in Table S3, and its bridge width."""
    width, resistance = SAMPLES_S3[int(rng.integers(len(SAMPLES_S3)))]
    r = float(np.clip(resistance * np.exp(0.07 * rng.standard_normal()), 88.0, 400.0))
    c = float(np.clip(101e-6 + 16e-6 * rng.standard_normal(), 75e-6, 130e-6))
    kappa, phi = 4.0e-6 * float(rng.uniform(0.75, 1.25)), 2.3e-4 * float(rng.uniform(0.75, 1.25))
    return Physics(R=r, C=c, tau_g=float(rng.uniform(2.0e-3, 4.5e-3)), kappa=kappa, phi=phi), width


def draw_instruments(rng: Rng) -> Instruments:
    """Draw the instruments with their noise, and the ambient temperature."""
    whites = {
        TEMPERATURE: float(rng.uniform(0.1, 0.4)),
        DISPLACEMENT: float(rng.uniform(1e-6, 3e-6)),
        FORCE: float(rng.uniform(3e-4, 1e-3)),
    } | dict.fromkeys(MIRRORS, float(rng.uniform(2e-5, 6e-5)))
    colours = {name: draw_noise_colour(rng, white) for name, white in whites.items()}
    baseline = {
        TEMPERATURE: float(rng.uniform(0.05, 0.15)),
        DISPLACEMENT: float(rng.uniform(3e-7, 1.5e-6)),
        FORCE: float(rng.uniform(1e-4, 4e-4)),
    } | dict.fromkeys(MIRRORS, 5e-6)
    stated = {name: white * float(rng.uniform(0.77, 1.3)) for name, white in whites.items() if rng.random() < 0.5}
    rates = {name: float(rng.choice([1000.0, 2000.0, 2500.0, 5000.0])) for name in (TEMPERATURE, DISPLACEMENT, FORCE)}
    run_variation = RunVariation(float(rng.uniform(0.002, 0.008)), float(rng.uniform(1e-5, 3e-5)), baseline)
    start = datetime(2025, 3, 3, 9, 0, 0, tzinfo=UTC) + timedelta(minutes=float(int(rng.integers(60 * 24 * 60))))
    return Instruments(
        colours,
        run_variation,
        stated,
        missing=float(rng.uniform(0.0, 0.02)),
        rates=rates | dict.fromkeys(MIRRORS, 5000.0),
        cooling_rc=float(rng.uniform(3.0, 6.0)),
        ambient_k=float(rng.uniform(293.0, 298.0)),
        ambient_amplitude_k=float(rng.uniform(0.2, 1.0)),
        ambient_period_s=float(rng.uniform(1800.0, 7200.0)),
        start=start,
    )


def draw_design(rng: Rng, base: Physics, instruments: Instruments, *, pixels: bool, mirrors: bool) -> list[Experiment]:
    """Draw the experiments in the order of the session, one entry per run."""
    rc = base.R * base.C
    top = min(FULL_POWER_W, MAX_ABSORBER_K * 0.95 / (0.66 * base.R))
    lead = float(rng.uniform(0.010, 0.050))
    with_force = {"ladder": rng.random() < 0.6, "width": rng.random() < 0.5, "train": rng.random() < 0.5}
    with_force[str(rng.choice(["ladder", "train"]))] = True

    def build_times(span: float, force: bool, slow: float | None = None) -> dict[str, np.ndarray]:
        names = (TEMPERATURE, DISPLACEMENT, FORCE) if force else (TEMPERATURE, DISPLACEMENT)
        return {n: draw_sample_times(rng, span, min(instruments.rates[n], slow or 1e9)) for n in names}

    def single(name: str, width: float, power: float, force: bool, pixel: int = 0, pulsed: int = 0) -> Experiment:
        span = lead + width + instruments.cooling_rc * rc
        return Experiment(name, np.array([[lead, width, power, pulsed]]), build_times(span, force), pixel)

    hold = float(np.clip(rng.uniform(0.06, 0.12), min(2.5 * rc, 0.12), 0.12))
    rungs = np.linspace(0.5, top, int(rng.integers(3, 6))) * np.exp(0.03 * rng.standard_normal())
    rungs = np.clip(rungs, 0.4, top).round(3)
    ladder = [single(f"ladder-{p:.2f}W", hold, float(p), bool(with_force["ladder"])) for p in rungs]
    widths = np.exp(rng.uniform(np.log(0.002), np.log(0.05), int(rng.integers(2, 4)))).round(4)
    strength = float(rng.uniform(0.7, 1.0) * top)
    short = [single(f"width-{1e3 * w:.1f}ms", float(w), strength, bool(with_force["width"])) for w in sorted(widths)]
    trains = []
    for k in range(int(rng.integers(1, 3))):
        width, gap = float(rng.uniform(0.005, 0.02)), float(rng.uniform(0.02, 0.06))
        length, power = float(rng.uniform(1.0, 4.0)), float(rng.uniform(0.6, 1.0) * top)
        starts = lead + np.arange(max(int(length / (width + gap)), 6)) * (width + gap)
        drive = np.column_stack([starts, np.full((len(starts), 3), [width, power, 0.0])])
        span = float(starts[-1] + width + instruments.cooling_rc * rc + rng.uniform(0.0, 0.4))
        slow = float(rng.uniform(200.0, 1000.0))
        trains.append(Experiment(f"train-{k + 1}", drive, build_times(span, bool(with_force["train"]), slow)))
    beside = [single("neighbour-only", hold, strength, False, pulsed=1)]
    if pixels:
        for other in range(1, int(rng.integers(3, 5))):
            beside.append(single(f"pixel-{other}", hold, float(rungs[-1]), False, pixel=other, pulsed=other))
    if mirrors:
        moves = draw_mirror_steps(rng)
        times = np.arange(int((moves[-1, 0] + 0.015) * 5000.0)) / 5000.0 + 1e-4
        beside.append(Experiment("mirror", np.zeros((0, 4)), dict.fromkeys(MIRRORS, times), commands=moves))
    reference = single("reference", float(rng.uniform(0.02, 0.05)), strength, bool(with_force["ladder"]))
    return _schedule_runs(rng, [*ladder, *short, *trains, *beside], reference)


def _schedule_runs(rng: Rng, experiments: list[Experiment], reference: Experiment) -> list[Experiment]:
    """Distribute repeats over 20 to 30 runs, blocked or mixed, with the reference pulse first and last."""
    budget = 30 - 4
    repeats = np.full(len(experiments), 2)
    while repeats.sum() > budget:  # two ladders less rather than one repeat
        experiments, repeats = experiments[1:], repeats[1:]
    wish = int(rng.integers(max(16, int(repeats.sum())), budget + 1))
    while repeats.sum() < wish:
        k = int(rng.integers(len(experiments)))
        repeats[k] = min(repeats[k] + 1, 4)
    middle = [replace(e, repeats=int(n)) for e, n in zip(experiments, repeats, strict=True) for _ in range(n)]
    if rng.random() < 0.5:
        middle = [middle[int(k)] for k in rng.permutation(len(middle))]
    early, late = replace(reference, name="reference-early"), replace(reference, name="reference-late")
    return [early, early, *middle, late, late]


def _add_dose(dose: dict[int, float], pulses: np.ndarray) -> None:
    for _, width, power, pulsed in pulses:
        dose[int(pulsed)] = dose.get(int(pulsed), 0.0) + float(width * power)


def build_session_runs(
    rng: Rng, design: list[Experiment], instruments: Instruments, *, before: list[Run] | None = None, drop: float = 0.0
) -> list[Run]:
    """Return the runs of a session in order, optionally after earlier runs."""
    runs: list[Run] = []
    before = before or []
    clock = before[-1].session_s + 600.0 if before else 0.0
    dose: dict[int, float] = {}
    for run in before:
        _add_dose(dose, run.experiment.pulses)
    repeat_counts: dict[str, int] = {}
    noise_seed = int(rng.integers(1_000_000)) * 1000
    for k, experiment in enumerate(design, start=len(before)):
        clock += float(rng.uniform(20.0, 90.0))
        repeat_counts[experiment.name] = repeat_counts.get(experiment.name, 0) + 1
        shown = list(experiment.times)
        if drop and experiment.commands is None and rng.random() < drop:
            shown.remove(str(rng.choice([TEMPERATURE, DISPLACEMENT])))
        room = instruments.ambient_k + instruments.ambient_amplitude_k * np.sin(
            2 * np.pi * clock / instruments.ambient_period_s
        )
        runs.append(
            Run(
                name=f"r{k:03d}-{experiment.name}-{repeat_counts[experiment.name]}",
                experiment=experiment,
                session_s=clock,
                dose_j=dose.get(experiment.pixel, 0.0),
                ambient_k=float(room),
                stated_ambient_k=float(room + 0.05 * rng.standard_normal()),
                power=float(1.0 + instruments.run_variation.power * rng.standard_normal()),
                late_s=float(instruments.run_variation.timing_s * rng.standard_normal()),
                noise_seed=noise_seed + k,
                shown=tuple(shown),
            )
        )
        _add_dose(dose, experiment.pulses)
    return runs


def simulate_ideal_signals(truth: Physics, run: Run, *, jittered: bool) -> dict[str, np.ndarray]:
    e = run.experiment
    return simulate_signals(
        truth,
        e.pulses,
        {name: e.times[name] for name in run.shown},
        pixel=e.pixel,
        ambient_k=run.ambient_k,
        session_s=run.session_s,
        dose_j=run.dose_j,
        noise_seed=run.noise_seed,
        factor=run.power if jittered else 1.0,
        late_s=run.late_s if jittered else 0.0,
        commands=e.commands,
    )


def _draw_missing(rng: Rng, n: int, share: float) -> np.ndarray:
    """Draw the lost samples, single and in bursts."""
    lost = rng.random(n) < 0.5 * share
    for start in np.flatnonzero(rng.random(n) < 0.5 * share / 6.0):
        lost[start : start + int(rng.integers(3, 10))] = True
    return lost


def write_run(parent, run: Run, truth: Physics, instruments: Instruments, rng: Rng, width: float | None) -> None:
    group = parent.create_group(run.name)
    group.attrs["ambient_K"] = run.stated_ambient_k
    group.attrs["group"] = run.experiment.name
    group.attrs["started_at"] = (instruments.start + timedelta(seconds=run.session_s)).isoformat()
    if width is not None:
        group.attrs["bridge_width_m"] = float(width)
    group.create_dataset("pulses", data=np.asarray(run.experiment.pulses, np.float64))
    if run.experiment.commands is not None:
        group.create_dataset("commands", data=np.asarray(run.experiment.commands, np.float64))
    for name, t, value in measure_signals(run, truth, instruments, rng):
        signal = group.create_group(name)
        signal.attrs["pixel"] = run.experiment.pixel
        if name in instruments.stated:
            signal.attrs["sigma"] = instruments.stated[name]
        signal.create_dataset("t_s", data=t)
        signal.create_dataset("value", data=value)


def measure_signals(run: Run, truth: Physics, instruments: Instruments, rng: Rng) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, times and noisy values of each signal, NaN where a sample is missing."""
    for name, ideal in simulate_ideal_signals(truth, run, jittered=True).items():
        t = run.experiment.times[name]
        dt = float(t[-1] - t[0]) / (len(t) - 1)
        offset = instruments.run_variation.baseline[name] * rng.standard_normal()
        value = ideal + offset + instruments.colours[name].sample(rng, len(t), dt)
        value[_draw_missing(rng, len(t), instruments.missing)] = np.nan
        yield name, np.asarray(t, np.float64), np.asarray(value, np.float64)


def write_recording(
    path, runs: list[Run], truth: Physics, instruments: Instruments, rng: Rng, width: float | None
) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "optotactile-recording"
        file.attrs["version"] = 1
        file.create_group("runs")
        for run in runs:
            write_run(file["runs"], run, truth, instruments, rng, width)


def build_scene(base: Physics, runs: list[Run]) -> SessionScale:
    signals = tuple(n for n in (TEMPERATURE, DISPLACEMENT, FORCE) if any(n in r.shown for r in runs))
    own = {r.experiment.name: r.experiment for r in runs if len(r.experiment.pulses)}
    gas, rise, dose = 0.0, 0.0, 0.0
    for e in own.values():
        edges, powers = find_edges(e.pulses, e.pixel)
        if len(edges):
            grid = np.linspace(0.0, float(edges[-1]) + 0.01, 2000)
            theta, inside = compute_nominal_rises(edges, powers, grid, base.R, base.C, base.tau_g)
            gas, rise = max(gas, float(inside.max())), max(rise, float(theta.max()))
    for r in runs:
        on_zero = r.experiment.pulses[r.experiment.pulses[:, 3].astype(int) == 0]
        dose += float(np.sum(on_zero[:, 1] * on_zero[:, 2]))
    pulsed = sorted({int(p) for r in runs if r.experiment.pixel for p in r.experiment.pulses[:, 3]} | {0})
    return SessionScale(base, signals, gas, rise, dose, runs[-1].session_s, tuple(pulsed))


def reduce_power(design: list[Experiment], share: float) -> list[Experiment]:
    """Return the same session with less power."""
    done: dict[int, Experiment] = {}
    for e in design:
        if id(e) not in done:
            drive = e.pulses.copy()
            drive[:, 2] *= share
            done[id(e)] = replace(e, pulses=drive)
    return [done[id(e)] for e in design]


def build_bench(base: Physics, instruments: Instruments, runs: list[Run]) -> Bench:
    """Return the detectability bench of these runs."""
    rows = [
        BenchRun(_build_key(r), r.experiment.pulses, _select_times(r), r.experiment.pixel, r.stated_ambient_k)
        for r in runs
    ]
    spread = dict(instruments.run_variation.baseline)
    spread[TEMPERATURE] = float(np.hypot(spread[TEMPERATURE], 0.05))
    return Bench(base, rows, instruments.colours, replace(instruments.run_variation, baseline=spread))


def _build_key(run: Run) -> str:
    return run.experiment.name + "|" + ",".join(run.shown)


def _select_times(run: Run) -> dict[str, np.ndarray]:
    return {name: run.experiment.times[name] for name in run.shown}


def simulate_ideal_rises(base: Physics, runs: list[Run], truth: Physics) -> list[dict[str, np.ndarray]]:
    """Return the noise-free signals: rises above ambient, mirrors relative to their commands."""
    each = bool(
        truth.ageing
        or truth.room
        or truth.hop
        or truth.missed
        or truth.hum_is_random
        or truth.jump_signal
        or truth.wander_signal
    )
    kept: dict[str, dict[str, np.ndarray]] = {}
    result = []
    for run in runs:
        key = run.name if each else _build_key(run)
        if key not in kept:
            kept[key] = {}
            for name, y in simulate_ideal_signals(truth, run, jittered=False).items():
                if name == TEMPERATURE:
                    y = y - run.ambient_k
                elif name in MIRRORS:
                    y = y - simulate_ideal_signals(base, run, jittered=False)[name]
                kept[key][name] = y
        result.append(kept[key])
    return result
