"""A lab's session with a hidden display: design, noise, file, and further experiments on request.

    case = draw_case("single", seed, folder)            # block: "none", "single", "pair", "unknown"
    case = draw_case("single", seed, folder, cause="laser_droop")
    case.path, case.causes, case.sizes, case.base, case.effect_sigma
    case.measure([[0.02, 0.05, 2.0, 0]], ["absorber_temperature_K"], folder)   # old runs and three new ones

Import with `tests/blind` on the path. Everything is determined by (block, seed, cause).
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from blind_causes import CATALOGUE, CONFUSABLE, MECHANISMS, Draw, Effect, SessionScale, apply_effects
from blind_display import FULL_POWER_W, MIRRORS, Physics, compute_max_rise_k
from blind_noise import Bench, subtract_signals
from blind_rivals import compute_rivals
from blind_session import (
    MAX_ABSORBER_K,
    SAMPLES,
    Experiment,
    Instruments,
    Run,
    build_bench,
    build_scene,
    build_session_runs,
    draw_base,
    draw_design,
    draw_instruments,
    draw_mirror_steps,
    draw_sample_times,
    reduce_power,
    simulate_ideal_rises,
    write_recording,
    write_run,
)

BLOCKS = ("none", "single", "pair", "unknown")
MIN_EFFECT_SIGMA = 15.0

Rng = np.random.Generator


@dataclass
class Case:
    """A recording with its ground truth."""

    path: Path
    block: str
    seed: int
    causes: tuple[str, ...]
    sizes: dict[str, float]
    base: dict[str, float]
    effect_sigma: float
    effects: tuple[Effect, ...]
    truth: Physics
    runs: list[Run]
    instruments: Instruments
    more: int = 0
    # Pair: of each cause given the other. Unknown: residual of the best three catalogue causes.
    each_sigma: dict[str, float] = field(default_factory=dict)

    def measure(
        self,
        pulses: Iterable[Sequence[float]],
        signals: Sequence[str],
        folder: str | Path,
        *,
        pixel: int | None = None,
        commands: np.ndarray | None = None,
        repeats: int = 3,
    ) -> Path:
        """Repeat one more experiment on the same display. Return a recording with the old and the new runs.

        Every call starts from the recording as drawn. `pixel` is the measured one: by default 0 if pixel 0 or its
        neighbour 1 is pulsed, else the first pulsed pixel.
        """
        self.more += 1
        rng = np.random.default_rng([self.seed, BLOCKS.index(self.block), 4242, self.more])
        drive = np.array([list(p)[:4] for p in pulses], float).reshape(-1, 4)
        _check_drive(drive)
        pulsed = sorted(set(drive[:, 3].astype(int)))
        if pixel is None:
            pixel = 0 if not pulsed or pulsed[0] <= 1 else pulsed[0]
        moves = draw_mirror_steps(rng) if commands is None else np.asarray(commands, float)
        last = float((drive[:, 0] + drive[:, 1]).max()) if len(drive) else 0.0
        rc = self.base["R"] * self.base["C"]
        end = last + max(5.0 * rc, 0.15 * (last if len(drive) > 5 else 0.0))
        names = [s.split("@")[0] for s in signals]
        times = {}
        for name in names:
            span = float(moves[-1, 0]) + 0.015 if name in MIRRORS else end
            times[name] = draw_sample_times(rng, span, self.instruments.rates.get(name, 5000.0))
            if name in MIRRORS:  # halfway between two steps of 0.2 ms, as in the design
                times[name] = np.arange(min(int(span * 5000.0), SAMPLES)) / 5000.0 + 1e-4
        turning = any(name in MIRRORS for name in names)
        experiment = Experiment(f"asked-{self.more}", drive, times, pixel, repeats, moves if turning else None)
        runs = build_session_runs(rng, [experiment] * repeats, self.instruments, before=self.runs)
        path = Path(folder) / f"{self.path.stem}-more{self.more}.h5"
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(self.path, path)
        with h5py.File(path, "a") as file:
            width = next(iter(file["runs"].values())).attrs.get("bridge_width_m")
            for run in runs:
                write_run(file["runs"], run, self.truth, self.instruments, rng, width)
        return path


def _check_drive(drive: np.ndarray) -> None:
    order = drive[np.argsort(drive[:, 0])] if len(drive) else drive
    if np.any(drive[:, 2] > FULL_POWER_W * 1.0001) or np.any(drive[:, :3] < 0.0):
        raise ValueError("a pulse exceeds the full power, or has a negative time or power")
    if np.any(order[1:, 0] < order[:-1, 0] + order[:-1, 1] - 1e-9):
        raise ValueError("pulses overlap on the one beam")


@dataclass
class _Session:
    """A session whose effects are redrawn until they are detectable."""

    base: Physics
    instruments: Instruments
    design: list[Experiment]
    runs: list[Run]
    bench: Bench
    scene: SessionScale


def build_session(base: Physics, instruments: Instruments, design: list[Experiment], seeds: list[int]) -> _Session:
    """Return the session of a design, with its bench."""
    runs = build_session_runs(np.random.default_rng(seeds), design, instruments, drop=0.06)
    return _Session(base, instruments, design, runs, build_bench(base, instruments, runs), build_scene(base, runs))


def is_too_hot(session: _Session, truth: Physics) -> bool:
    """Return whether a pulse on the measured pixel burns its absorber."""
    pulsed = {r.experiment.name: r.experiment for r in session.runs if len(r.experiment.pulses)}
    own = [e for e in pulsed.values() if e.pulses[0, 3] == e.pixel]
    return any(compute_max_rise_k(truth, e.pulses, e.pixel) > MAX_ABSORBER_K for e in own)


def _draw_detectable_effects(
    rng: Rng, session: _Session, draws: list[Draw], seeds: list[int], *, hidden: bool, silent: bool
):
    """Draw effects until all are detectable. The power is reduced first where the absorber would burn."""
    min_sigma = 0.0 if silent else MIN_EFFECT_SIGMA
    for _ in range(25):
        effects = tuple(d(rng, session.scene) for d in draws)
        truth = apply_effects(session.base, effects)
        trial = session
        while is_too_hot(trial, truth):
            trial = build_session(session.base, session.instruments, reduce_power(trial.design, 0.88), seeds)
        shown = simulate_ideal_rises(trial.base, trial.runs, truth)
        if trial.bench.sigma(shown, refits=1) < min_sigma:
            continue
        total = trial.bench.sigma(shown)
        if total < min_sigma:
            continue
        each: dict[str, float] = {}
        if len(effects) > 1:
            for own in effects:
                alone = simulate_ideal_rises(trial.base, trial.runs, apply_effects(trial.base, (own,)))
                extra = subtract_signals(shown, alone)
                each[own.key] = min(trial.bench.sigma(alone), trial.bench.sigma(shown, extras=(extra,)))
        if hidden:
            left = compute_rivals(trial.base, trial.instruments, trial.runs, truth)
            each = dict(list(left.items())[:3])
        if not each or min(each.values()) >= min_sigma:
            return trial, effects, truth, total, each
    return None


def _draw_session(seeds: list[int], chosen: tuple[str, ...]) -> tuple[Rng, _Session, float]:
    """Return a sample, its lab and its session without effects, and the bridge width."""
    rng = np.random.default_rng(seeds)
    base, width = draw_base(rng)
    instruments = draw_instruments(rng)
    pixels = "beam_misalignment" in chosen or rng.random() < 0.2
    mirrors = "mirror_lag" in chosen or rng.random() < 0.25
    design = draw_design(rng, base, instruments, pixels=pixels, mirrors=mirrors)
    return rng, build_session(base, instruments, design, [*seeds, 1]), width


def draw_case(
    block: str,
    seed: int,
    folder: str | Path,
    *,
    cause: str | None = None,
    mechanism: str | None = None,
    draw: Draw | None = None,
    name: str = "case.h5",
) -> Case:
    """Draw a hidden display and a session with it, write `<folder>/case.h5`, and return it with the ground truth."""
    keys = list(CATALOGUE)
    if block == "single":
        chosen: tuple[str, ...] = (cause or keys[seed % len(keys)],)
        draws = [draw or CATALOGUE[chosen[0]]]
    elif block == "unknown":
        hidden = mechanism or list(MECHANISMS)[seed % len(MECHANISMS)]
        chosen, draws = ("unknown", hidden), [MECHANISMS[hidden]]
    elif block == "pair":
        able = [k for k in keys if k != "sensor_scale"]
        pairs = [p for p in itertools.combinations(able, 2) if frozenset(p) not in CONFUSABLE]
        order = np.random.default_rng(20250303).permutation(len(pairs))
        chosen = pairs[int(order[seed % len(pairs)])]
        draws = [CATALOGUE[k] for k in chosen]
    elif block == "none":
        chosen, draws = (), []
    else:
        raise ValueError(f"block is {block!r}, expected one of {BLOCKS}")
    everything = [*CATALOGUE, *MECHANISMS]
    root = [BLOCKS.index(block), seed, *(everything.index(k) for k in chosen if k != "unknown")]
    silent = not draws or "sensor_scale" in chosen
    for attempt in itertools.count():  # another sample where no size of an effect is detectable
        seeds = [*root, 100 + attempt] if attempt else root
        rng, session, width = _draw_session(seeds, chosen)
        found = _draw_detectable_effects(rng, session, draws, [*seeds, 1], hidden=block == "unknown", silent=silent)
        if found is not None:
            break
    session, effects, truth, sigma, each = found
    path = Path(folder) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    stated_width = width if rng.random() < 0.5 else None
    noise = np.random.default_rng([*seeds, 2])
    write_recording(path, session.runs, truth, session.instruments, noise, stated_width)
    return Case(
        path=path,
        block=block,
        seed=seed,
        causes=chosen,
        sizes={f"{e.key}.{k}": v for e in effects for k, v in e.sizes.items()},
        base={k: getattr(session.base, k) for k in ("R", "C", "tau_g", "kappa", "phi")},
        effect_sigma=sigma if draws else 0.0,
        effects=effects,
        truth=truth,
        runs=session.runs,
        instruments=session.instruments,
        each_sigma=each,
    )
