"""What a term may add to the nominal pixel: hooks that every file of `optodrive.physics.terms` fills as it needs.

Heat sits in nodes (the absorber, walls) and flows between them and to ambient. Gas and touch surface follow heat but
carry none in this uncoupled form: the absorber loses nothing to them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from optodrive.flow import FloatArray
from optodrive.neighbours import Neighbours

Values = Mapping[str, float]
"""A term's parameters, SI, by name."""


@dataclass(frozen=True)
class TermParameter:
    """A parameter of a term: its unit, the plausible range, and where the range comes from."""

    name: str
    unit: str
    low: float
    high: float
    source: str


class View(NamedTuple):
    """What a term sees: rises above ambient by the names of states, each [p]; ambient; the lattice."""

    rise_k: Mapping[str, FloatArray]
    ambient_k: float
    neighbours: Neighbours | None

    def wall_k(self) -> FloatArray:
        """Walls' rise, zero where no term warms them: [p]."""
        return self.rise_k.get("wall_k", np.zeros_like(self.rise_k["absorber_k"]))


@dataclass
class Flows:
    """Heat on its way, W, each [p]: into a node, by its name; and to ambient for good."""

    into_w: dict[str, FloatArray] = field(default_factory=dict)
    left_w: FloatArray | float = 0.0

    def move(self, source: str | None, target: str | None, power_w: FloatArray) -> None:
        """Let heat flow from a node to another; None is ambient, at either end."""
        for node, gained_w in ((source, -power_w), (target, power_w)):
            if node is None:
                self.left_w = self.left_w + gained_w
            else:
                self.into_w[node] = self.into_w.get(node, 0.0) + gained_w


class Term:
    """One effect. Hooks that a term does not fill leave the model as it is.

    key: its name in files; needs: keys of terms it builds on
    heat_nodes: states that store heat, and the parameter that is their capacity; followers: states that store none
    """

    key: str
    parameters: tuple[TermParameter, ...] = ()
    needs: tuple[str, ...] = ()
    heat_nodes: Mapping[str, str] = {}
    followers: tuple[str, ...] = ()

    def bridge_k_per_w(self, values: Values, view: View, r_k_per_w: FloatArray) -> FloatArray:
        """The bridge's resistance, given what it would be without the term: [p]."""
        return r_k_per_w

    def flow(self, values: Values, view: View, flows: Flows) -> None:
        """Add heat flows between nodes and to ambient."""

    def rates_k_per_s(self, values: Values, view: View) -> dict[str, FloatArray]:
        """How fast the term's followers move: name → [p]."""
        return {}

    def displacement_m(self, values: Values, view: View, displacement_m: FloatArray) -> FloatArray:
        """The membrane's displacement, given what it would be without the term: [p]."""
        return displacement_m

    def force_n(self, values: Values, view: View, force_n: FloatArray) -> FloatArray:
        """Blocked force, given what it would be without the term: [p]."""
        return force_n
