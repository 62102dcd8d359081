"""Hypotheses on a recording: every way in which a term could explain it."""

from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.physics.hypothesis import Hypothesis, RecordingScope
from optodrive.physics.terms import discover_terms

CLOCKS = ("temperature", "displacement", "force", "mirrors", "mirrors")
"""Clock of each kind of signal, in the order of `dataset.SIGNALS`."""


def build_hypotheses(data: Dataset) -> list[Hypothesis]:
    """Return every hypothesis that this recording can show."""
    scope = _describe_scope(data)
    terms = (term for term in discover_terms().values() if term.signature and scope.subsystem in term.subsystems)
    return [hypothesis for term in terms for hypothesis in term.build_hypotheses(scope)]


def _describe_scope(data: Dataset) -> RecordingScope:
    return RecordingScope(
        signals=tuple(dict.fromkeys(CLOCKS[kind] for kind in data.kinds)),
        pixels=tuple(data.pixels),
        illuminated=frozenset(int(pixel) for run in data.runs for pixel in run.pulses[:, 3]),
        has_neighbour_pulses=any(
            bool((experiment.pulses[:, 3] != experiment.pixel).any()) for experiment, _ in data.experiments
        ),
        power_levels=len({round(float(power_w), 3) for run in data.runs for power_w in run.pulses[:, 2]}),
    )
