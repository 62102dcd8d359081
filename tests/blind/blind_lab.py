"""One lab's session with a hidden display: its design, its noise, its file, and one more experiment when asked.

    case = draw("single", seed, folder)            # block: "none", "single", "pair", "unknown"
    case = draw("single", seed, folder, cause="laser_droop")
    case.path, case.causes, case.sizes, case.base, case.effect_sigma
    case.measure([[0.02, 0.05, 2.0, 0]], ["absorber_temperature_K"], folder)   # old runs and three new ones

Import with `tests/blind` on the path. Everything follows from (block, seed, cause).
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from blind_causes import CATALOGUE, CONFUSABLE, MECHANISMS, Draw, Effect, Scene, install
from blind_display import FULL_POWER_W, MIRRORS, Physics, hottest
from blind_noise import Bench, minus
from blind_rivals import rivals
from blind_session import (
    HOTTEST_K,
    SAMPLES,
    Experiment,
    Habits,
    Run,
    bench_of,
    cooler,
    draw_base,
    draw_design,
    draw_habits,
    ideal_rises,
    mirror_steps,
    sample_times,
    scene_of,
    session_runs,
    write_run,
)

BLOCKS = ("none", "single", "pair", "unknown")
ENOUGH_SIGMA = 15.0

Rng = np.random.Generator


@dataclass
class Case:
    """A recording with the truth behind it."""

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
    habits: Habits
    more: int = 0
    # A pair: of each cause when the other is known. An unknown: what the best three catalogue causes leave.
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
        """One more experiment on the same display, three times; returns a recording with the old runs and the new.

        Every call starts from the recording as drawn. `pixel` is the one looked at: by default 0 when pixel 0 or its
        neighbour 1 is lit, else the first lit.
        """
        self.more += 1
        rng = np.random.default_rng([self.seed, BLOCKS.index(self.block), 4242, self.more])
        drive = np.array([list(p)[:4] for p in pulses], float).reshape(-1, 4)
        _check_drive(drive)
        lit = sorted(set(drive[:, 3].astype(int)))
        if pixel is None:
            pixel = 0 if not lit or lit[0] <= 1 else lit[0]
        moves = mirror_steps(rng) if commands is None else np.asarray(commands, float)
        last = float((drive[:, 0] + drive[:, 1]).max()) if len(drive) else 0.0
        rc = self.base["R"] * self.base["C"]
        end = last + max(5.0 * rc, 0.15 * (last if len(drive) > 5 else 0.0))
        wanted = [s.split("@")[0] for s in signals]
        times = {}
        for name in wanted:
            span = float(moves[-1, 0]) + 0.015 if name in MIRRORS else end
            times[name] = sample_times(rng, span, self.habits.rates.get(name, 5000.0))
            if name in MIRRORS:  # halfway between two steps of 0.2 ms, as in the design
                times[name] = np.arange(min(int(span * 5000.0), SAMPLES)) / 5000.0 + 1e-4
        turning = any(name in MIRRORS for name in wanted)
        experiment = Experiment(f"asked-{self.more}", drive, times, pixel, repeats, moves if turning else None)
        runs = session_runs(rng, [experiment] * repeats, self.habits, before=self.runs)
        path = Path(folder) / f"{self.path.stem}-more{self.more}.h5"
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(self.path, path)
        with h5py.File(path, "a") as file:
            width = next(iter(file["runs"].values())).attrs.get("bridge_width_m")
            for run in runs:
                write_run(file["runs"], run, self.truth, self.habits, rng, width)
        return path


def _check_drive(drive: np.ndarray) -> None:
    order = drive[np.argsort(drive[:, 0])] if len(drive) else drive
    if np.any(drive[:, 2] > FULL_POWER_W * 1.0001) or np.any(drive[:, :3] < 0.0):
        raise ValueError("a pulse asks for more than the full power, or for a negative time or power")
    if np.any(order[1:, 0] < order[:-1, 0] + order[:-1, 1] - 1e-9):
        raise ValueError("pulses overlap on the one beam")


@dataclass
class _Session:
    """A session whose display is not settled yet: effects are tried on it until they show."""

    base: Physics
    habits: Habits
    design: list[Experiment]
    runs: list[Run]
    bench: Bench
    scene: Scene


def _prepare(base: Physics, habits: Habits, design: list[Experiment], seeds: list[int]) -> _Session:
    runs = session_runs(np.random.default_rng(seeds), design, habits, drop=0.06)
    return _Session(base, habits, design, runs, bench_of(base, habits, runs), scene_of(base, runs))


def _too_hot(session: _Session, truth: Physics) -> bool:
    lit = {r.experiment.name: r.experiment for r in session.runs if len(r.experiment.pulses)}
    own = [e for e in lit.values() if e.pulses[0, 3] == e.pixel]
    return any(hottest(truth, e.pulses, e.pixel) > HOTTEST_K for e in own)


def _settle(rng: Rng, session: _Session, draws: list[Draw], seeds: list[int], *, hidden: bool, silent: bool):
    """Draw effects until all show enough; the light is turned down first where the absorber would burn."""
    least = 0.0 if silent else ENOUGH_SIGMA
    for _ in range(25):
        effects = tuple(d(rng, session.scene) for d in draws)
        truth = install(session.base, effects)
        trial = session
        while _too_hot(trial, truth):
            trial = _prepare(session.base, session.habits, cooler(trial.design, 0.88), seeds)
        shown = ideal_rises(trial.base, trial.runs, truth)
        if trial.bench.sigma(shown, refits=1) < least:
            continue
        total = trial.bench.sigma(shown)
        if total < least:
            continue
        each: dict[str, float] = {}
        if len(effects) > 1:
            for own in effects:
                alone = ideal_rises(trial.base, trial.runs, install(trial.base, (own,)))
                extra = minus(shown, alone)
                each[own.key] = min(trial.bench.sigma(alone), trial.bench.sigma(shown, extras=(extra,)))
        if hidden:
            left = rivals(trial.base, trial.habits, trial.runs, truth)
            each = dict(list(left.items())[:3])
        if not each or min(each.values()) >= least:
            return trial, effects, truth, total, each
    return None


def _open_lab(seeds: list[int], chosen: tuple[str, ...]) -> tuple[Rng, _Session, float]:
    """A sample, its lab and its session, nothing hidden yet; also the bridge width."""
    rng = np.random.default_rng(seeds)
    base, width = draw_base(rng)
    habits = draw_habits(rng)
    pixels = "beam_misalignment" in chosen or rng.random() < 0.2
    mirrors = "mirror_lag" in chosen or rng.random() < 0.25
    design = draw_design(rng, base, habits, pixels=pixels, mirrors=mirrors)
    return rng, _prepare(base, habits, design, [*seeds, 1]), width


def draw(
    block: str,
    seed: int,
    folder: str | Path,
    *,
    cause: str | None = None,
    mechanism: str | None = None,
    name: str = "case.h5",
) -> Case:
    """Draw a hidden display and a session with it, write `<folder>/case.h5`, return it with the truth."""
    keys = list(CATALOGUE)
    if block == "single":
        chosen: tuple[str, ...] = (cause or keys[seed % len(keys)],)
        draws = [CATALOGUE[chosen[0]]]
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
    for attempt in itertools.count():  # where no size of an effect shows, the next lab has another sample
        seeds = [*root, 100 + attempt] if attempt else root
        rng, session, width = _open_lab(seeds, chosen)
        found = _settle(rng, session, draws, [*seeds, 1], hidden=block == "unknown", silent=silent)
        if found is not None:
            break
    session, effects, truth, sigma, each = found
    path = Path(folder) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    stated_width = width if rng.random() < 0.5 else None
    noise = np.random.default_rng([*seeds, 2])
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "optotactile-recording"
        file.attrs["version"] = 1
        file.create_group("runs")
        for run in session.runs:
            write_run(file["runs"], run, truth, session.habits, noise, stated_width)
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
        habits=session.habits,
        each_sigma=each,
    )
