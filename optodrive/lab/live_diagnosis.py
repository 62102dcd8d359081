"""Campaigns that measure for themselves: play, diagnose, choose the next experiment, until one explanation is left.

Theory of operation

Every run is in the recording's file before the next one begins, and the recording is all that the loop remembers: a
second call counts the runs of the first campaign that the file lacks, plays these, and goes on by what the diagnosis
of all runs proposes. The loop ends with one explanation of at least `CERTAIN`, without a proposal, or with the time.

An experiment is a plan that the limiter passes. The bench is an exclusive board with the sensor that records its
pixels; a campaign needs of it only what `Bench` states.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from hashlib import sha256
from math import ceil
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, RefusedError
from optodrive.core.types.arrays import FloatArray, ReadOnlyArrays
from optodrive.core.types.discrepancy import Discrepancy, NextExperiment, Probabilities
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.core.types.plans import LimitedPlan
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.core.worker_process import WorkerProcess
from optodrive.device.config import Config, build_pixel_layout
from optodrive.lab.commissioning.exclusive_board import LOOP_STEP_S, ExclusiveBoard
from optodrive.lab.commissioning.sensor import SensorReader
from optodrive.lab.diagnosis.next_steps import CERTAIN
from optodrive.lab.recording import read_recording, write_recording
from optodrive.link.session.plan_job import PlanJob
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence

LEAD_S = 0.02
"""Time that is recorded before the first pulse."""
TAIL_S, TRAIN_TAIL_S = 0.1, 0.3
"""Time that is recorded after the last pulse of an experiment; a train also warms the walls."""
TRAIN_PULSES = 10
"""Number of pulses from which an experiment counts as a train."""
LADDER = (0.25, 0.5, 1.0)
"""Powers of the pulses of the ladder, relative to the largest."""
WIDTHS_S = (0.002, 0.006, 0.02)
LADDER_REST_S, WIDTHS_REST_S = 0.11, 0.08
"""Gate-off time between two pulses, in which the absorber cools."""
TRAIN_WIDTH_S, TRAIN_GAP_S, TRAIN_COUNT = 0.02, 0.04, 25
FIRST_ORDER = ("ladder", "widths", "train", "ladder", "widths", "train", "ladder", "widths")
"""Experiments of the first campaign in their order: repeats lie apart, and show what drifts or ages."""
POWER_STEP, POWER_MIN = 0.9, 0.05
"""Factor by which the power of an experiment above a cap is reduced, and the smallest one that is tried."""
REPEATS_MAX = 4
"""Runs of one proposal before the next diagnosis, which may propose it again."""
NO_EFFECT, NONE_OF_THESE = "no effect", "none of these causes"
SAMPLES_MAX = 1000
"""Samples per signal and run: two signals then take 2 s on the sensor's line."""
STEP_MIN_US = 200
REST_S = 2.0
"""Time from the end of a run to the next one, in which pixel and gas cool."""


@dataclass(frozen=True, eq=False)
class Experiment(ReadOnlyArrays):
    """An experiment on one pixel.

    pulses: [n, 4] start_s, width_s, power_w, pixel as planned, the first at LEAD_S; span_s: time that is recorded
    """

    name: str
    plan: LimitedPlan
    pulses: FloatArray
    pixel: int
    span_s: float


def find_pixels(config: Config) -> tuple[int, int]:
    """Return the pixel nearest to the centre of a display, and the pixel nearest to that one, itself if it is alone."""
    layout = build_pixel_layout(config.display)
    centre = int(np.argmin(np.hypot(layout.x_m, layout.y_m)))
    distance_m = np.hypot(layout.x_m - layout.x_m[centre], layout.y_m - layout.y_m[centre])
    order = np.argsort(distance_m, kind="stable")
    return centre, int(order[min(1, len(order) - 1)])


def plan_first_experiments(display: DisplayModel, pixel: int, neighbour: int) -> dict[str, Experiment]:
    """Plan the first campaign, by the names of FIRST_ORDER.

    A ladder of powers held as long as the caps allow, then the neighbour alone; a series of widths; and a train.
    """
    laser, limits = display.config.laser, display.config.limits
    hold_s = min(0.05, limits.pulse_width_max_s)
    if laser.is_on_off:
        raise InputError("laser.modulation", laser.modulation, "'pwm': a diagnosis compares several powers")
    ladder = [
        (hold_s, max(share * laser.max_power_w, display.config.min_power_w), pixel, LADDER_REST_S) for share in LADDER
    ]
    if neighbour != pixel:
        ladder.append((hold_s, laser.max_power_w, neighbour, LADDER_REST_S))
    widths = [(min(width_s, hold_s), laser.max_power_w, pixel, WIDTHS_REST_S) for width_s in WIDTHS_S]
    train = [(min(TRAIN_WIDTH_S, hold_s), laser.max_power_w, pixel, TRAIN_GAP_S)] * TRAIN_COUNT
    kinds = {"ladder": ladder, "widths": widths, "train": train}
    return {name: plan_experiment(display, name, _place(rows), pixel) for name, rows in kinds.items()}


def plan_proposal(display: DisplayModel, proposal: NextExperiment) -> Experiment:
    """Plan an experiment that a diagnosis proposes. Equal ones have equal names, by which they are repeats."""
    digest = sha256(np.round(proposal.pulses * [1e6, 1e6, 1e4, 1.0]).tobytes()).hexdigest()[:6]
    return plan_experiment(display, f"next-{digest}", proposal.pulses, proposal.pixel)


def plan_experiment(display: DisplayModel, name: str, pulses: FloatArray, pixel: int) -> Experiment:
    """Plan pulses [n, 4], with less power where a cap of the cold display asks for it.

    Raises RefusedError if even a small fraction of the power exceeds a cap, or the laser does not emit it.
    """
    share = 1.0
    while True:
        if share * pulses[:, 2].min() < display.config.min_power_w:
            raise RefusedError(f"{name}: a pulse within the caps is weaker than the laser emits")
        try:
            plan = _plan_pulses(display, pulses * [1.0, 1.0, share, 1.0])
            break
        except RefusedError:
            share *= POWER_STEP
            if share < POWER_MIN:
                raise
    planned = np.column_stack([plan.start_s - plan.start_s[0] + LEAD_S, plan.width_s, plan.power_w, plan.pixel])
    tail_s = TRAIN_TAIL_S if len(planned) >= TRAIN_PULSES else TAIL_S
    return Experiment(name, plan, planned, pixel, float(planned[-1, 0] + planned[-1, 1]) + tail_s)


def _plan_pulses(display: DisplayModel, pulses: FloatArray) -> LimitedPlan:
    """Plan single pulses, of whole PWM periods. Raise RefusedError if one exceeds a cap."""
    steps_hz = display.config.laser.width_steps_hz
    trains = []
    for start_s, width_s, power_w, pixel in pulses.tolist():
        width_s = max(1, round(width_s * steps_hz)) / steps_hz
        trains.append(PulseTrain(int(pixel), start_s - pulses[0, 0], width_s, width_s, 0.01, power_w))
    return plan_sequence(display, FrameSequence((), tuple(trains)), *display.build_cold_state(), policy="refuse").plan


def _place(rows: Iterable[tuple[float, float, int, float]]) -> FloatArray:
    """Return pulses [n, 4] of rows of width, power, pixel and the rest that follows."""
    out, start_s = [], LEAD_S
    for width_s, power_w, pixel, rest_s in rows:
        out.append((start_s, width_s, power_w, pixel))
        start_s += width_s + rest_s
    return np.array(out)


class Bench(Protocol):
    """A display with instruments."""

    def measure(self, experiment: Experiment) -> Run:
        """Play an experiment within the caps and return its run."""

    def now_s(self) -> float:
        """Return the time in the laboratory, s."""

    def run_elsewhere(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Run a function of a module while the bench is looked after, and return its result."""

    def disarm(self) -> None:
        """Turn all light off until the next run."""


@dataclass(frozen=True)
class CampaignStep:
    """State after a diagnosis.

    lab_s: time in the laboratory since the call; runs: in the recording; played: names of the experiments played since
    the last diagnosis
    """

    lab_s: float
    runs: int
    played: tuple[str, ...]
    verdict: str
    causes: tuple[str, ...]
    probabilities: dict[str, float]


@dataclass(frozen=True, eq=False)
class CampaignResult:
    """All steps, the last diagnosis, and why the campaign ended: "certain", "no_proposal" or "budget"."""

    steps: tuple[CampaignStep, ...]
    diagnosis: Discrepancy
    ended: str


class CampaignRecording:
    """The recording of a campaign, replaced as a whole after every run, so that it is complete whenever one looks."""

    def __init__(self, path: Path, display: str) -> None:
        """Continue the file if there is one. Raise InputError if it is of another display."""
        self.path, self._display = path, display
        self.runs: list[Run] = list(read_recording(path).runs) if path.exists() else []
        for run in self.runs:
            if run.attributes.get("display") != display or "group" not in run.attributes:
                stated = run.attributes.get("display", "none")
                expected = f"{display!r}, which the campaign goes on with"
                raise InputError(f"{path}: {run.name}: display", stated, expected)

    @property
    def measurement(self) -> Measurement:
        """All runs."""
        return Measurement(tuple(self.runs))

    def count_by_group(self) -> Counter[str]:
        """Return the number of runs of each experiment."""
        return Counter(str(run.attributes["group"]) for run in self.runs)

    def append(self, run: Run, group: str, bench: Bench) -> None:
        """Add a run and write the file. Raise RefusedError if it cannot be written."""
        attributes = run.attributes | {"group": group, "display": self._display}
        self.runs.append(replace(run, name=f"run{len(self.runs):03d}-{group}", attributes=attributes))
        bench.run_elsewhere(write_recording, self.path, self.measurement, "optodrive diagnose --live")


def run_campaign(
    bench: Bench,
    display: DisplayModel,
    pixels: tuple[int, int],
    recording: CampaignRecording,
    diagnose: Callable[[Measurement, Config], Discrepancy],
    budget_s: float,
    on_step: Callable[[CampaignStep], None],
    on_run: Callable[[str], None],
) -> CampaignResult:
    """Run a campaign on a pixel and its neighbour.

    diagnose: a function of a module; budget_s: time in the laboratory, which only the first ones may exceed;
    on_step: called after every diagnosis; on_run: with the name of each experiment before it is played, '' for none
    """
    began_s = bench.now_s()
    steps: list[CampaignStep] = []
    played: list[str] = []
    longest_s = 0.0

    def play(experiment: Experiment) -> None:
        nonlocal longest_s
        on_run(experiment.name)
        start_s = bench.now_s()
        recording.append(bench.measure(experiment), experiment.name, bench)
        played.append(experiment.name)
        longest_s = max(longest_s, bench.now_s() - start_s)

    first = plan_first_experiments(display, *pixels)
    done = recording.count_by_group()
    for name in FIRST_ORDER:
        if done[name]:
            done[name] -= 1
        else:
            play(first[name])
    while True:
        bench.disarm()
        on_run("")
        diagnosis: Discrepancy = bench.run_elsewhere(diagnose, recording.measurement, display.config)
        found = diagnosis.verdict, diagnosis.causes, name_probabilities(diagnosis.probabilities)
        step = CampaignStep(bench.now_s() - began_s, len(recording.runs), tuple(played), *found)
        steps.append(step)
        played.clear()
        on_step(step)
        if is_certain(diagnosis):
            return CampaignResult(tuple(steps), diagnosis, "certain")
        proposal = diagnosis.next_experiment
        if proposal is None:
            return CampaignResult(tuple(steps), diagnosis, "no_proposal")
        experiment = plan_proposal(display, proposal)
        for _ in range(min(proposal.repeats, REPEATS_MAX)):
            if bench.now_s() - began_s + max(longest_s, experiment.span_s) > budget_s:
                break
            play(experiment)
        if not played:
            return CampaignResult(tuple(steps), diagnosis, "budget")


def is_certain(diagnosis: Discrepancy) -> bool:
    """Return whether one explanation is certain, or causes are named, each of which is."""
    probabilities = diagnosis.probabilities
    return diagnosis.verdict == "cause" or max(name_probabilities(probabilities).values()) >= CERTAIN


def name_probabilities(probabilities: Probabilities) -> dict[str, float]:
    """Return the probabilities of all explanations by their names, most probable first."""
    named = {" and ".join(keys): value for keys, value in probabilities.causes.items()}
    named |= {NO_EFFECT: probabilities.no_effect, NONE_OF_THESE: probabilities.none_of_these}
    return dict(sorted(named.items(), key=lambda item: -item[1]))


class BoardBench:
    """Plays experiments on a connected board, which is armed from the first run to `disarm`."""

    def __init__(self, board: ExclusiveBoard, reader: SensorReader, worker: WorkerProcess, clock: Clock) -> None:
        self._board, self._reader, self._worker, self._clock = board, reader, worker, clock
        self._is_armed = False
        self._rested_s = 0.0

    def now_s(self) -> float:
        """Return the host's time, s."""
        return self._clock.now_s()

    def measure(self, experiment: Experiment) -> Run:
        """Play an experiment once it fits all caps, and return the sensor's recording of it.

        The run has the pulses that the board reported. Raises RefusedError if it reported fewer than planned.
        """
        board = self._board
        if not self._is_armed:
            board.arm()
            self._is_armed = True
        board.wait(max(0.0, self._rested_s - self.now_s()))
        step_us = max(STEP_MIN_US, ceil(experiment.span_s * 1e6 / SAMPLES_MAX))
        count = int(experiment.span_s * 1e6 / step_us)
        jobs: list[PlanJob] = []
        self._reader.begin_recording(experiment.pixel, count, step_us)
        started = datetime.now(UTC).isoformat()
        board.play(experiment.plan, jobs.append)
        board.wait(experiment.span_s - float(experiment.pulses[-1, 0]))
        values = self._reader.read_recording(count)
        self._rested_s = self.now_s() + REST_S
        scale = board.session.scale
        executed = jobs[-1].build_executed(experiment.plan, scale)
        if len(executed) != len(experiment.pulses):
            raise RefusedError(f"{experiment.name}: {len(executed)} of {len(experiment.pulses)} pulses were reported")
        start_s = LEAD_S + (executed.on_tick - executed.on_tick[0]) * scale.tick_s
        pulses = np.column_stack([start_s, executed.width_s, executed.power_w, executed.pixel])
        t_s: FloatArray = np.arange(count, dtype=np.float64) * (step_us * 1e-6)
        signals = {name: Signal(experiment.pixel, t_s, value) for name, value in values.items()}
        width_m = board.config.display.bridge_width_m
        attributes: dict[str, str | float] = {"started_at": started, "bridge_width_m": width_m}
        return Run(experiment.name, board.display.ambient_k, pulses, signals, attributes)

    def run_elsewhere(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Run a function of a module in another process. An armed board keeps its lease meanwhile."""
        self._worker.submit(function, *arguments)
        while not self._worker.is_ready():
            if self._is_armed:
                self._board.step()
            else:
                self._board.session.step(LOOP_STEP_S, renew_lease=False)
        return self._worker.result()

    def disarm(self) -> None:
        """Disarm the board, which is armed again for the next run."""
        if self._is_armed:
            self._is_armed = False
            self._board.disarm()
