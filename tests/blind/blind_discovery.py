"""What a discovery in a pixel should answer for each mechanism outside the catalogue, and the score of its answers.

The expectations follow from the generator's physics (`blind_display`) and were written before any measurement.

membrane_resonance: the displacement rings about the gas, which takes two hidden states; a term of present states can
only imitate its mean lag. glare: the displacement meter reads a share of the light while the gate is on. mode_hops: the
light falls by a share at random times, other ones in every run. membrane_play: the displacement follows with dead
travel, of a sign that is that of the gas's rate once the travel is taken up. thermometer_ceiling: the thermometer shows
only a share of what exceeds a temperature. second_node: heat flows into a part that follows the absorber with one time
constant. hum: a line of 50 Hz, of one phase in the time of all runs, in one signal. late_light: light after the gate
has closed, for a while or fading. missed_pulses: pulses of a train stay dark, other ones in every run. melting: heat
capacity in a narrow range of temperatures. one_way_gas: the gas follows a falling drive at another rate than a rising
one. slack_membrane: the first part of the displacement is missing.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Expectation:
    """Nodes and classes of formula that count as right."""

    nodes: tuple[str, ...]
    kinds: tuple[str, ...]


EXPECTED = {
    "membrane_resonance": Expectation(("membrane",), ("oscillation",)),
    "glare": Expectation(("sensor",), ("linear",)),
    "mode_hops": Expectation(("light",), ("random",)),
    "membrane_play": Expectation(("membrane",), ("dry friction", "saturation")),
    "thermometer_ceiling": Expectation(("sensor",), ("end stop",)),
    "second_node": Expectation(("absorber", "wall"), ("memory",)),
    "hum": Expectation(("sensor",), ("sine",)),
    "late_light": Expectation(("light",), ("step", "decay", "end stop", "bump")),
    "missed_pulses": Expectation(("light",), ("random",)),
    "melting": Expectation(("absorber",), ("bump",)),
    "one_way_gas": Expectation(("gas",), ("end stop", "absolute value")),
    "slack_membrane": Expectation(("membrane",), ("dead zone", "end stop", "saturation")),
}


@dataclass(frozen=True)
class Answer:
    """What was found in one recording: of the strongest finding the node and the class, and the gain of all."""

    hidden: str
    node: str
    kind: str
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
