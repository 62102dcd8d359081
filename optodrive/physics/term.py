"""What a term may add to the nominal pixel: hooks that every file of `optodrive.physics.terms` fills as it needs.

Heat sits in nodes (the absorber, walls) and flows between them and to ambient. Gas and touch surface follow heat but
carry none in this uncoupled form: the absorber loses nothing to them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.neighbours import Neighbours

Values = Mapping[str, float]
"""A term's parameters, SI, by name."""


ABSORBER, GAS, WALL, NEIGHBOUR, SHOWN, OWN = range(6)
"""Rows of a single pixel's states in kernels: its own three, the absorber beside it, what a thermometer that lags
shows, then each term's followers."""
POWER_W, FULL_W, SINCE_S, DOSE, PIXEL, AMBIENT_K, FLOW_W, WALL_K, TIME_S, SESSION, MINE = range(11)
"""What kernels are told beside the states.

Commanded and full power, time since the gate opened, dose so far as a share of the recording's, the index of the pixel
that is lit, ambient, the bridge's heat flow, its far end's rise, time in the run, and in the session from −1 to 1, and
whether the light is on this very pixel.
"""
CONTEXT = 11

Modifier = Callable[[FloatArray, FloatArray, int, FloatArray, float], float]
Mover = Callable[[FloatArray, FloatArray, int, FloatArray, FloatArray], None]


class Kernels(NamedTuple):
    """A term in the compiled single pixel.

    Each takes (v, y, s, c, x), v the term's parameters in order, y the states, s the row of its first follower, c the
    context, x the value without the term; and returns it with the term.

    light: W on the absorber; capacity: J/K; bridge: K/W; leaving: W from the absorber to the room; wall: rise of the
    bridge's far end, K; rates: writes to x, dy/dt; lifts, pushes: the gas's rise that lifts the membrane, that pushes
    a finger, K; reads: the rise that the thermometer shows, K; lag: the thermometer's, s
    """

    light: Modifier | None = None
    capacity: Modifier | None = None
    bridge: Modifier | None = None
    leaving: Modifier | None = None
    wall: Modifier | None = None
    rates: Mover | None = None
    lifts: Modifier | None = None
    pushes: Modifier | None = None
    reads: Modifier | None = None
    lag: Modifier | None = None


@dataclass(frozen=True)
class TermParameter:
    """A parameter of a term: its unit, where a fit begins, the plausible range, and where the range comes from."""

    name: str
    unit: str
    default: float
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


class Most(NamedTuple):
    """The most there is: one absorber's rise; all absorbers' rises together, one beam's, K; the laser's power, W."""

    absorber_k: float
    together_k: float
    full_w: float


class Warming(NamedTuple):
    """The most a term adds to what warms.

    Factors on the power absorbed and on the heat capacity of a hot absorber; and what warms everything otherwise, K.
    """

    power: float = 1.0
    capacity: float = 1.0
    everywhere_k: float = 0.0


NO_WARMING = Warming()


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
    kernels: the same for one compiled pixel; suspect: where in measured data it shows, for causes of a discrepancy;
    by_run: whether repeats of one drive differ, by what came before or by the room;
    quick: whether it moves within a gas time constant; never_warmer: nothing that can burn gets warmer by it; for
    other terms `warming` says by how much at most
    """

    key: str
    parameters: tuple[TermParameter, ...] = ()
    needs: tuple[str, ...] = ()
    heat_nodes: Mapping[str, str] = {}
    followers: tuple[str, ...] = ()
    kernels: Kernels = Kernels()
    suspect: str = ""
    by_run: bool = False
    quick: bool = False
    never_warmer: bool = False

    @property
    def whole_display(self) -> bool:
        """Whether the term acts in the model of a whole display, not in the compiled single pixel alone."""
        hooks = ("bridge_k_per_w", "flow", "rates_k_per_s", "displacement_m", "force_n")
        return any(getattr(type(self), name) is not getattr(Term, name) for name in hooks)

    @property
    def single_pixel(self) -> bool:
        """Whether nothing of the term is lost in the compiled single pixel."""
        return any(self.kernels) or not self.whole_display

    def warming(self, values: Values, most: Most) -> Warming | None:
        """What a bound on heat must add for the term; None where it cannot say, and the limiter refuses the term."""
        return NO_WARMING if self.never_warmer else None

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
