"""The loop of a live diagnosis: measure, diagnose, choose the experiment that separates the rivals, measure again.

Theory of operation

Every run is in the recording's file before the next one begins, and the recording is all that the loop remembers: a
second call counts the runs of the first campaign that the file lacks, plays these, and goes on by what the diagnosis
of all runs proposes. The loop ends with one explanation of at least `CERTAIN`, without a proposal, or with the time.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from optodrive.core.errors import InputError
from optodrive.core.types.discrepancy import Discrepancy, Probabilities
from optodrive.core.types.measurements import Measurement, Run
from optodrive.device.config import Config
from optodrive.lab.diagnosis.next_experiment import CERTAIN
from optodrive.lab.live_diagnosis.experiments import FIRST_ORDER, Experiment, plan_first_experiments, plan_proposal
from optodrive.lab.recording import read_recording, write_recording
from optodrive.planning.display_model import DisplayModel

REPEATS_MAX = 4
"""Runs of one proposal before the next diagnosis, which may propose it again."""
NO_EFFECT, NONE_OF_THESE = "no effect", "none of these causes"


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
                raise InputError(
                    f"{path}: {run.name}: display", stated, f"{display!r}, which the campaign goes on with"
                )

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
        step = CampaignStep(
            bench.now_s() - began_s,
            len(recording.runs),
            tuple(played),
            diagnosis.verdict,
            diagnosis.causes,
            name_probabilities(diagnosis.probabilities),
        )
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
