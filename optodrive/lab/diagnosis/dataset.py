"""A recording as one long vector of finite samples, in blocks: one signal of one run each."""

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import Measurement, Run
from optodrive.physics.pixel_ode import Scene

SIGNALS = ("absorber_temperature_K", "displacement_m", "force_N", "mirror_x_rad", "mirror_y_rad")
"""Kinds of signals, by number; the first three are a pixel's."""
BoolArray = NDArray[np.bool_]
PIXEL_KINDS, MIRROR_KINDS = (0, 1, 2), (3, 4)
FULL_W = 2.45
CORNER_S = 6e-5
"""Temperature has a corner at each edge of the light: samples so near to one depend on jitter in no linear way."""


@dataclass(frozen=True, eq=False)
class Block:
    """One signal of one run: kind as in SIGNALS, its place in the vector, sample times."""

    run: int
    kind: int
    pixel: int
    part: slice
    t_s: FloatArray


@dataclass(frozen=True, eq=False)
class RunInfo:
    """What is known of a run beside its samples; group: runs that repeat one experiment share it."""

    name: str
    group: str
    ambient_k: float
    pulses: FloatArray
    commands: FloatArray | None


@dataclass(frozen=True, eq=False)
class Alike:
    """Scenes under the same drive: one with all their samples' times, and where each block finds its own."""

    scene: Scene
    rows: tuple[tuple[int, int, IntArray], ...]


@dataclass(frozen=True, eq=False)
class Dataset:
    """A recording laid out. alike: the scenes again, repeats together.

    value: [m] temperature rise over the stated ambient, displacement, force, mirror angle; SI
    """

    runs: tuple[RunInfo, ...]
    blocks: tuple[Block, ...]
    scenes: tuple[tuple[Scene, tuple[int, int, int]], ...]
    alike: tuple["Alike", ...]
    value: FloatArray

    def kinds(self) -> list[int]:
        """Kinds of signals that occur."""
        return sorted({block.kind for block in self.blocks})

    def pixels(self) -> list[int]:
        """Pixels measured."""
        return sorted({block.pixel for block in self.blocks if block.kind in PIXEL_KINDS})

    def halves(self) -> list["Dataset"]:
        """What pixels do and what mirrors do, as far as there is any: they share nothing but the clock."""
        found = []
        for kinds in (PIXEL_KINDS, MIRROR_KINDS):
            runs = sorted({block.run for block in self.blocks if block.kind in kinds})
            if runs:
                found.append(self.only(runs, kinds))
        return found

    def groups(self) -> dict[str, list[int]]:
        """Runs of each group, by number."""
        found: dict[str, list[int]] = {}
        for number, run in enumerate(self.runs):
            found.setdefault(run.group, []).append(number)
        return found

    def contrasts(self) -> int:
        """So many runs repeat an earlier one: what the noise model is estimated from."""
        return len(self.runs) - len(self.groups())

    def only(self, runs: list[int], kinds: tuple[int, ...] = (*PIXEL_KINDS, *MIRROR_KINDS)) -> "Dataset":
        """The same with these runs, and kinds of signals, alone; doses and session times stay as they were."""
        new = {old: number for number, old in enumerate(runs)}
        blocks: list[Block] = []
        values: list[FloatArray] = []
        moved: dict[int, int] = {}
        at = 0
        for number, block in enumerate(self.blocks):
            if block.run not in new or block.kind not in kinds:
                continue
            count = block.part.stop - block.part.start
            moved[number] = len(blocks)
            blocks.append(Block(new[block.run], block.kind, block.pixel, slice(at, at + count), block.t_s))
            values.append(self.value[block.part])
            at += count
        scenes = []
        for scene, places in self.scenes:
            if any(place in moved for place in places):
                first, second, third = (moved.get(place, -1) for place in places)
                scenes.append((scene, (first, second, third)))
        return Dataset(
            tuple(self.runs[old] for old in runs),
            tuple(blocks),
            tuple(scenes),
            _alike(scenes),
            np.concatenate(values) if values else np.zeros(0),
        )


def dataset(measurement: Measurement) -> Dataset:
    """Lay out a recording; InputError where nothing in it can be compared with the model."""
    runs = measurement.runs
    clock = _clock(runs)
    order = np.argsort(clock, kind="stable")
    span = max(float(clock.max() - clock.min()), 1e-9)
    full_w = max([FULL_W, *(float(run.pulses[:, 2].max()) for run in runs if len(run.pulses))])
    total_j, before_j = _doses(runs, order)
    whole_j = max([1e-12, *total_j.values()])  # a joule wears one pixel as it wears another
    blocks: list[Block] = []
    scenes: list[tuple[Scene, tuple[int, int, int]]] = []
    values: list[FloatArray] = []
    timed = all("started_at" in run.attributes for run in runs)
    at = 0
    for number, run in enumerate(runs):
        by_pixel: dict[int, dict[int, int]] = {}
        for name, signal in run.signals.items():
            kind = SIGNALS.index(name)
            good = np.isfinite(signal.value)
            if kind == 0:
                good &= _off_corners(signal.t_s, run.pulses)
            value = signal.value[good] - (run.ambient_k if kind == 0 else 0.0)
            if not len(value):
                continue
            if kind in PIXEL_KINDS:
                by_pixel.setdefault(signal.pixel, {})[kind] = len(blocks)
            blocks.append(Block(number, kind, signal.pixel, slice(at, at + len(value)), signal.t_s[good]))
            values.append(value)
            at += len(value)
        for pixel, places in by_pixel.items():
            spots = (places.get(0, -1), places.get(1, -1), places.get(2, -1))
            times = tuple(blocks[place].t_s if place >= 0 else np.zeros(0) for place in spots)
            scene = Scene(
                pulses=run.pulses[np.argsort(run.pulses[:, 0], kind="stable")],
                pixel=pixel,
                ambient_k=run.ambient_k,
                t_s=(times[0], times[1], times[2]),
                dose_before=before_j[number].get(pixel, 0.0) / whole_j,
                dose_per_j=1.0 / whole_j,
                session=float(2.0 * (clock[number] - clock.min()) / span - 1.0),
                session_per_s=2.0 / span if timed else 0.0,
                full_w=full_w,
            )
            scenes.append((scene, spots))
    if not blocks:
        raise InputError("recording", "no finite sample", "signals to compare with the model")
    return Dataset(
        tuple(_info(run) for run in runs), tuple(blocks), tuple(scenes), _alike(scenes), np.concatenate(values)
    )


def _alike(scenes: list[tuple[Scene, tuple[int, int, int]]]) -> tuple[Alike, ...]:
    together: dict[tuple[bytes, int], list[tuple[Scene, tuple[int, int, int]]]] = {}
    for scene, places in scenes:
        together.setdefault((scene.pulses.tobytes(), scene.pixel), []).append((scene, places))
    found = []
    for members in together.values():
        times = [np.unique(np.concatenate([scene.t_s[kind] for scene, _ in members])) for kind in PIXEL_KINDS]
        rows = tuple(
            (kind, places[kind], np.searchsorted(times[kind], scene.t_s[kind]))
            for scene, places in members
            for kind in PIXEL_KINDS
            if places[kind] >= 0
        )
        found.append(Alike(replace(members[0][0], t_s=(times[0], times[1], times[2])), rows))
    return tuple(found)


def _off_corners(t_s: FloatArray, pulses: FloatArray) -> BoolArray:
    edges_s = np.sort(np.concatenate([[-np.inf], pulses[:, 0], pulses[:, 0] + pulses[:, 1], [np.inf]]))
    row = np.searchsorted(edges_s, t_s)
    return np.asarray(np.minimum(t_s - edges_s[row - 1], edges_s[row] - t_s) > CORNER_S)


def _info(run: Run) -> RunInfo:
    group = str(run.attributes.get("group", run.name))
    return RunInfo(run.name, group, run.ambient_k, run.pulses, run.commands)


def _clock(runs: tuple[Run, ...]) -> FloatArray:
    """Start of each run, s: as stated, else one after the other."""
    stated = [run.attributes.get("started_at") for run in runs]
    if all(isinstance(word, str) for word in stated):
        try:
            return np.array([datetime.fromisoformat(str(word)).timestamp() for word in stated])
        except ValueError:
            pass
    return np.arange(float(len(runs)))


def _doses(runs: tuple[Run, ...], order: IntArray) -> tuple[dict[int, float], list[dict[int, float]]]:
    """Energy on each pixel in all, and before each run, J."""
    so_far: dict[int, float] = {}
    before: list[dict[int, float]] = [{} for _ in runs]
    for number in order.tolist():
        before[number] = dict(so_far)
        for _, width_s, power_w, pixel in runs[number].pulses.tolist():
            so_far[int(pixel)] = so_far.get(int(pixel), 0.0) + width_s * power_w
    return so_far, before
