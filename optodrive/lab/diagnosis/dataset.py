"""Recording as one vector of finite samples, in blocks of one signal of one run each, and its hypotheses."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import Measurement, Run
from optodrive.lab.inspection.start_times import read_start_times
from optodrive.physics.hypothesis import Hypothesis, RecordingScope
from optodrive.physics.pixel_ode import PixelExperiment
from optodrive.physics.term import RecordedRun
from optodrive.physics.terms import discover_terms

SIGNALS = ("absorber_temperature_K", "displacement_m", "force_N", "mirror_x_rad", "mirror_y_rad")
"""Signal kinds by number; the first three belong to a pixel, the others to the mirrors."""
BoolArray = NDArray[np.bool_]
PIXEL_KINDS, MIRROR_KINDS = (0, 1, 2), (3, 4)
FULL_POWER_W = 2.45
COMMAND_DIGITS = 6
"""Digits of mirror commands, s and rad, within which they are equal."""
EDGE_EXCLUSION_S = 6e-5
"""Temperature samples closer to a gate edge are excluded: timing jitter acts nonlinearly on the kink there."""
NEVER_S: FloatArray = np.zeros(0)
"""Times of a signal that was not measured."""
CLOCKS = ("temperature", "displacement", "force", "mirrors", "mirrors")
"""Clock of each kind of signal, in the order of `dataset.SIGNALS`."""


@dataclass(frozen=True, eq=False)
class Block:
    """Samples of one signal of one run: kind is an index into SIGNALS, part the slice of the data vector.

    sampled_s: times at which its instrument sampled, t_s among them: a filter acted on all of them; rows: of t_s
    """

    run: int
    kind: int
    pixel: int
    part: slice
    t_s: FloatArray
    sampled_s: FloatArray
    rows: IntArray


class Samples(NamedTuple):
    """Samples of one signal of one run before they are joined, as in `Block`."""

    run: int
    kind: int
    pixel: int
    t_s: FloatArray
    value: FloatArray
    sampled_s: FloatArray


@dataclass(frozen=True, eq=False)
class RunInfo:
    """Properties of a run other than its samples. Runs that repeat one experiment share a group.

    has_stated_group: whether the recording states the group, rather than equal pulses
    """

    name: str
    group: str
    ambient_k: float
    pulses: FloatArray
    commands: FloatArray | None
    has_stated_group: bool = True


@dataclass(frozen=True, eq=False)
class DriveGroup:
    """Experiments with identical drive: one with all times of samples, and the rows of each block therein.

    block_rows: (kind, block number, rows)
    """

    experiment: PixelExperiment
    block_rows: tuple[tuple[int, int, IntArray], ...]


@dataclass(frozen=True, eq=False)
class Dataset:
    """Recording in vector form.

    experiments: one per run and pixel, with the numbers of its blocks by kind (−1: not measured); drive_groups: the
    same experiments grouped by drive; value: [m] temperature rise over the stated ambient, displacement, force, mirror
    angle; SI
    """

    runs: tuple[RunInfo, ...]
    blocks: tuple[Block, ...]
    experiments: tuple[tuple[PixelExperiment, tuple[int, int, int]], ...]
    drive_groups: tuple["DriveGroup", ...]
    value: FloatArray

    @property
    def kinds(self) -> list[int]:
        """Signal kinds that occur, sorted."""
        return sorted({block.kind for block in self.blocks})

    @property
    def pixels(self) -> list[int]:
        """Measured pixels, sorted."""
        return sorted({block.pixel for block in self.blocks if block.kind in PIXEL_KINDS})

    @cached_property
    def run_blocks(self) -> list[list[Block]]:
        """Blocks of each run, none for a run without."""
        blocks: list[list[Block]] = [[] for _ in self.runs]
        for block in self.blocks:
            blocks[block.run].append(block)
        return blocks

    def split_subsystems(self) -> list["Dataset"]:
        """Split the data into pixel and mirror signals, which share only the clock. Empty parts are omitted."""
        subsystems = []
        for kinds in (PIXEL_KINDS, MIRROR_KINDS):
            runs = sorted({block.run for block in self.blocks if block.kind in kinds})
            if runs:
                subsystems.append(self.select(runs, kinds))
        return subsystems

    @cached_property
    def recorded_runs(self) -> tuple[RecordedRun, ...]:
        """The run of each block, a default for those of mirrors."""
        recorded = [RecordedRun()] * len(self.blocks)
        for experiment, numbers in self.experiments:
            for number in (number for number in numbers if number >= 0):
                recorded[number] = experiment.recorded_run
        return tuple(recorded)

    @property
    def groups(self) -> dict[str, list[int]]:
        """Run numbers of each group."""
        by_group: dict[str, list[int]] = {}
        for number, run in enumerate(self.runs):
            by_group.setdefault(run.group, []).append(number)
        return by_group

    @property
    def contrast_count(self) -> int:
        """Number of runs that repeat an earlier run, from which the noise model is estimated."""
        return len(self.runs) - len(self.groups)

    def select(self, runs: list[int], kinds: tuple[int, ...] = (*PIXEL_KINDS, *MIRROR_KINDS)) -> "Dataset":
        """Return the data of these runs and signal kinds. Doses and session times stay unchanged."""
        numbers = {old: number for number, old in enumerate(runs)}
        samples = [
            Samples(numbers[block.run], block.kind, block.pixel, block.t_s, self.value[block.part], block.sampled_s)
            for block in self.blocks
            if block.run in numbers and block.kind in kinds
        ]
        experiments = [(self.blocks[max(blocks)].run, experiment) for experiment, blocks in self.experiments]
        kept = [(numbers[run], experiment) for run, experiment in experiments if run in numbers]
        return assemble_dataset(tuple(self.runs[old] for old in runs), samples, kept)

    def drop_ends(self, counts: Mapping[int, int]) -> "Dataset":
        """Return the data without this number of samples at both ends of each block [by block], but with their times.

        Half of the samples of a block stay at least.
        """
        samples = []
        for number, block in enumerate(self.blocks):
            size = len(block.sampled_s)
            count = min(counts.get(number, 0), size // 4)
            used = (block.rows >= count) & (block.rows < size - count)
            value = self.value[block.part][used]
            if len(value):
                samples.append(Samples(block.run, block.kind, block.pixel, block.t_s[used], value, block.sampled_s))
        experiments = [(self.blocks[max(blocks)].run, experiment) for experiment, blocks in self.experiments]
        return assemble_dataset(self.runs, samples, experiments)


def build_dataset(measurement: Measurement) -> Dataset:
    """Convert a recording to vector form. Raise InputError if it has no finite sample."""
    runs = measurement.runs
    stated_s = read_start_times(runs).seconds
    # Equal start times say nothing, and would make every drift infinitely fast.
    is_stated = stated_s is not None and len(runs) > 1 and bool(np.ptp(stated_s))
    # The order of the runs is at least known, and serves for ageing.
    start_times_s = stated_s if stated_s is not None and is_stated else np.arange(float(len(runs)))
    order = np.argsort(start_times_s, kind="stable")
    session_span_s = max(float(start_times_s.max() - start_times_s.min()), 1e-9)
    full_power_w = max([FULL_POWER_W, *(float(run.pulses[:, 2].max()) for run in runs if len(run.pulses))])
    total_doses_j, doses_before_j = _compute_doses_j(runs, order)
    max_total_j = max([1e-12, *total_doses_j.values()])  # dose per joule is equal for all pixels
    samples: list[Samples] = []
    experiments: list[tuple[int, PixelExperiment]] = []
    for number, run in enumerate(runs):
        measured = [item for name in run.signals if len((item := _select_samples(number, run, name)).value)]
        samples += measured
        for pixel in dict.fromkeys(item.pixel for item in measured if item.kind in PIXEL_KINDS):
            t_s = {item.kind: item.t_s for item in measured if item.pixel == pixel}
            experiment = PixelExperiment(
                pulses=run.pulses[np.argsort(run.pulses[:, 0], kind="stable")],
                pixel=pixel,
                ambient_k=run.ambient_k,
                t_s=(t_s.get(0, NEVER_S), t_s.get(1, NEVER_S), t_s.get(2, NEVER_S)),
                dose_before=doses_before_j[number].get(pixel, 0.0) / max_total_j,
                dose_per_j=1.0 / max_total_j,
                session_time=float(2.0 * (start_times_s[number] - start_times_s.min()) / session_span_s - 1.0),
                # Without real times nothing drifts within a run.
                session_time_per_s=2.0 / session_span_s if is_stated else 0.0,
                full_w=full_power_w,
            )
            experiments.append((number, experiment))
    if not samples:
        raise InputError("recording", "no finite sample", "signals to compare with the model")
    return assemble_dataset(_build_run_infos(runs), samples, experiments)


def _select_samples(number: int, run: Run, name: str) -> Samples:
    """Return the finite samples of a signal: of a temperature, the rise above ambient, and none at a gate's edge."""
    signal, kind = run.signals[name], SIGNALS.index(name)
    is_used = is_finite = np.isfinite(signal.value)
    if kind == 0:
        # Displacement and force have no kink there: the gas smooths it.
        is_used = is_finite & _is_off_edges(signal.t_s, run.pulses)
    value = signal.value[is_used] - (run.ambient_k if kind == 0 else 0.0)
    return Samples(number, kind, signal.pixel, signal.t_s[is_used], value, signal.t_s[is_finite])


def assemble_dataset(
    runs: tuple[RunInfo, ...], samples: Iterable[Samples], experiments: Iterable[tuple[int, PixelExperiment]]
) -> Dataset:
    """Join samples to one vector. Omit experiments that no sample belongs to.

    experiments: one per run and pixel, with the number of its run
    """
    blocks: list[Block] = []
    values, offset = [np.zeros(0)], 0
    for item in samples:
        part, rows = slice(offset, offset + len(item.value)), np.searchsorted(item.sampled_s, item.t_s)
        blocks.append(Block(item.run, item.kind, item.pixel, part, item.t_s, item.sampled_s, rows))
        values.append(item.value)
        offset += len(item.value)
    number_of = {(block.run, block.pixel, block.kind): number for number, block in enumerate(blocks)}
    numbered = []
    for run, experiment in experiments:
        first, second, third = (number_of.get((run, experiment.pixel, kind), -1) for kind in PIXEL_KINDS)
        if max(first, second, third) >= 0:
            numbered.append((experiment, (first, second, third)))
    return Dataset(runs, tuple(blocks), tuple(numbered), _group_by_drive(numbered, blocks), np.concatenate(values))


def _group_by_drive(
    experiments: list[tuple[PixelExperiment, tuple[int, int, int]]], blocks: list[Block]
) -> tuple[DriveGroup, ...]:
    by_drive: dict[tuple[bytes, int], list[tuple[PixelExperiment, tuple[int, int, int]]]] = {}
    for experiment, numbers in experiments:
        by_drive.setdefault((experiment.pulses.tobytes(), experiment.pixel), []).append((experiment, numbers))
    groups = []
    for members in by_drive.values():
        # Repeats of one drive are integrated once, at all their times.
        of_kind = [[numbers[kind] for _, numbers in members if numbers[kind] >= 0] for kind in PIXEL_KINDS]
        times = [np.unique(np.concatenate([NEVER_S, *(blocks[n].sampled_s for n in own)])) for own in of_kind]
        rows = tuple(
            (kind, number, np.searchsorted(times[kind], blocks[number].sampled_s))
            for kind, own in zip(PIXEL_KINDS, of_kind, strict=True)
            for number in own
        )
        groups.append(DriveGroup(replace(members[0][0], t_s=(times[0], times[1], times[2])), rows))
    return tuple(groups)


def _is_off_edges(t_s: FloatArray, pulses: FloatArray) -> BoolArray:
    edges_s = np.sort(np.concatenate([[-np.inf], pulses[:, 0], pulses[:, 0] + pulses[:, 1], [np.inf]]))
    row = np.searchsorted(edges_s, t_s)
    return np.asarray(np.minimum(t_s - edges_s[row - 1], edges_s[row] - t_s) > EDGE_EXCLUSION_S)


def _build_run_infos(runs: tuple[Run, ...]) -> tuple[RunInfo, ...]:
    """Return the properties of the runs. Runs without a group but with the same drive and pixels share one."""
    first: dict[tuple[object, ...], str] = {}
    infos = []
    for run in runs:
        pixels = tuple(sorted((name, signal.pixel) for name, signal in run.signals.items()))
        commands = None if run.commands is None else np.round(run.commands, COMMAND_DIGITS).tobytes()
        # The measured pixels belong to it: one drive, measured at two pixels, is no repeat.
        key = (_round_pulses(run.pulses).tobytes(), commands, pixels)
        stated = run.attributes.get("group")
        group = first.setdefault(key, run.name) if stated is None else str(stated)
        infos.append(RunInfo(run.name, group, run.ambient_k, run.pulses, run.commands, stated is not None))
    return tuple(infos)


def _round_pulses(pulses: FloatArray) -> FloatArray:
    """Return pulses rounded to 1 µs and 0.1 mW, within which they are equal, in order of time."""
    # + 0.0 turns −0.0 into 0.0, whose bytes differ.
    rounded = np.round(pulses * [1e6, 1e6, 1e4, 1.0]) + 0.0
    return np.asarray(rounded[np.argsort(rounded[:, 0], kind="stable")])


def _compute_doses_j(runs: tuple[Run, ...], order: IntArray) -> tuple[dict[int, float], list[dict[int, float]]]:
    """Return the total energy on each pixel, and that before each run, J."""
    accumulated_j: dict[int, float] = {}
    before_j: list[dict[int, float]] = [{} for _ in runs]
    for number in order.tolist():
        before_j[number] = dict(accumulated_j)
        for _, width_s, power_w, pixel in runs[number].pulses.tolist():
            accumulated_j[int(pixel)] = accumulated_j.get(int(pixel), 0.0) + width_s * power_w
    return accumulated_j, before_j


def build_hypotheses(data: Dataset) -> list[Hypothesis]:
    """Return every hypothesis that this recording can show."""
    scope = _describe_scope(data)
    # A term without a signature is no possible cause of a discrepancy.
    terms = (term for term in discover_terms().values() if term.signature and scope.subsystem in term.subsystems)
    return [hypothesis for term in terms for hypothesis in term.build_hypotheses(scope)]


def _describe_scope(data: Dataset) -> RecordingScope:
    groups = {
        recorded.session_time: data.runs[block.run].group
        for block, recorded in zip(data.blocks, data.recorded_runs, strict=True)
    }
    return RecordingScope(
        signals=tuple(dict.fromkeys(CLOCKS[kind] for kind in data.kinds)),
        pixels=tuple(data.pixels),
        illuminated=frozenset(int(pixel) for run in data.runs for pixel in run.pulses[:, 3]),
        has_neighbour_pulses=any(
            bool((experiment.pulses[:, 3] != experiment.pixel).any()) for experiment, _ in data.experiments
        ),
        power_levels=len({round(float(power_w), 3) for run in data.runs for power_w in run.pulses[:, 2]}),
        runs=tuple(groups.items()),
    )
