"""What a discovery in a pixel should answer for each mechanism outside the catalogue, and the score of its answers.

The expectations follow from the generator's physics (`blind_display`) and were written before any measurement.

membrane_resonance: the displacement rings about the gas, which takes two hidden states. glare: the displacement meter
reads a share of the light while the gate is on. mode_hops: the light falls by a share at random times, other ones in
every run. membrane_play: the displacement follows with dead travel: less an elastic element of the gas that slips, of a
sign that is that of the gas's rate once that is taken up. thermometer_ceiling: the thermometer shows only a share of
what exceeds a temperature. second_node: heat flows into a part that follows the absorber with one time constant. hum: a
line of 50 Hz, of one phase in the time of all runs, in one signal. late_light: light after the gate has closed, for a
while or fading. missed_pulses: pulses of a train stay dark, other ones in every run. melting: heat capacity in a narrow
range of temperatures. one_way_gas: the gas follows a falling drive at another rate than a rising one. slack_membrane:
the first part of the displacement is missing.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from blind_lab import Case
from blind_score import wilson
from optodrive.lab.diagnosis.nominal_fit import build_prior
from optodrive.lab.pixel_discovery import discover_in_pixel
from optodrive.lab.recording import read_recording


@dataclass(frozen=True)
class Expectation:
    """Nodes and classes of formula that count as right."""

    nodes: tuple[str, ...]
    kinds: tuple[str, ...]


EXPECTED = {
    "membrane_resonance": Expectation(("membrane",), ("oscillation",)),
    "glare": Expectation(("sensor",), ("linear",)),
    "mode_hops": Expectation(("light",), ("random",)),
    "membrane_play": Expectation(("membrane",), ("hysteresis", "dry friction", "saturation")),
    "thermometer_ceiling": Expectation(("sensor",), ("end stop",)),
    "second_node": Expectation(("absorber", "wall"), ("memory",)),
    "hum": Expectation(("sensor",), ("curve",)),
    "late_light": Expectation(("light",), ("threshold", "decay", "end stop", "curve")),
    "missed_pulses": Expectation(("light",), ("random",)),
    "melting": Expectation(("absorber",), ("curve",)),
    "one_way_gas": Expectation(("gas",), ("end stop", "absolute value")),
    "slack_membrane": Expectation(("membrane",), ("dead zone", "end stop", "saturation")),
}


@dataclass(frozen=True)
class Answer:
    """What was found in one recording: node, class and verdict of the strongest finding, and the gain of all."""

    seed: int
    hidden: str
    node: str
    kind: str
    verdict: str
    gain: float
    error_before: float
    error_after: float
    elapsed_s: float

    @property
    def has_right_node(self) -> bool:
        """Whether the strongest finding lies at the hidden mechanism's node."""
        return self.node in EXPECTED[self.hidden].nodes

    @property
    def has_right_kind(self) -> bool:
        """Whether node and class of formula are right."""
        return self.has_right_node and any(kind in EXPECTED[self.hidden].kinds for kind in self.kind.split(" and "))


def measure(case: Case) -> Answer:
    """Return what is found in a recording. An instrument's line is subtracted before, and is the answer then."""
    measurement = read_recording(case.path)
    prior, _ = build_prior(measurement, None)
    found = discover_in_pixel(measurement, prior)
    strongest = max(found.findings, key=lambda finding: finding.term.chosen.gain, default=None)
    node, kind, gain, verdict = "", "", 0.0, found.claim.verdict
    if strongest is not None:
        gain = sum(finding.term.chosen.gain for finding in found.findings)
        node, kind, verdict = strongest.node, strongest.kind, strongest.term.claim.verdict
    elif any(item.form == "line" for item in found.disturbances):
        node, kind, gain, verdict = "sensor", "curve", math.nan, "instrument"
    hidden = case.causes[-1] if case.causes else ""
    return Answer(case.seed, hidden, node, kind, verdict, gain, found.error_before, found.error_after, found.elapsed_s)


def format_table(answers: Iterable[Answer]) -> str:
    """Return the scores, and what was found for each mechanism, as Markdown."""
    every = list(answers)
    hidden, nulls = [each for each in every if each.hidden], [each for each in every if not each.hidden]
    gains = sorted(each.gain for each in hidden if not math.isnan(each.gain))
    lines = ["| score | hits | aim |", "|---|---|---|"]
    for name, hits, count, aim in (
        ("right node", sum(each.has_right_node for each in hidden), len(hidden), "≥ 80 %"),
        ("right class of formula", sum(each.has_right_kind for each in hidden), len(hidden), "≥ 60 %"),
        ("false discoveries in nulls", sum(bool(each.node) for each in nulls), len(nulls), "0"),
    ):
        low, high = wilson(hits, count)
        share = f"{hits / max(count, 1):.0%} ({low:.0%} to {high:.0%})"
        lines.append(f"| {name} | {hits}/{count}, {share} | {aim} |")
    if gains:
        lines.append(f"| held-out gain, median | {gains[len(gains) // 2]:.2f} of {len(gains)} | ≥ 0.8 |")
    seconds = sorted(each.elapsed_s for each in every)
    lines += [f"| time, median and largest | {seconds[len(seconds) // 2]:.0f} s, {seconds[-1]:.0f} s | ≤ 5 min |", ""]
    lines += ["| hidden | found: node, class, verdict, held-out gain |", "|---|---|"]
    for name in EXPECTED:
        own = [each for each in hidden if each.hidden == name]
        found = "; ".join(
            f"{each.node} {each.kind} {each.verdict} {each.gain:.2f}" if each.node else "nothing" for each in own
        )
        if own:
            lines.append(f"| {name} | {found} |")
    return "\n".join(lines) + "\n"
