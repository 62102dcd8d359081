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

TermValues = Mapping[str, float]
"""A term's parameters, SI, by name."""


ABSORBER, GAS, WALL, NEIGHBOUR, SENSOR, FIRST_FOLLOWER = range(6)
"""Rows of a single pixel's states in kernels: its own three, the absorber beside it, what a thermometer that lags
shows, then each term's followers."""
(
    POWER_W,
    FULL_W,
    SINCE_EDGE_S,
    DOSE,
    ILLUMINATED_PIXEL,
    AMBIENT_K,
    BRIDGE_FLOW_W,
    FAR_END_K,
    TIME_S,
    SESSION_TIME,
    IS_TARGET,
) = range(11)
"""What kernels are told beside the states.

Commanded and full power, time since the gate opened, dose so far as a share of the recording's, the index of the pixel
that is lit, ambient, the bridge's heat flow, its far end's rise, time in the run, and in the session from −1 to 1, and
whether the light is on this very pixel.
"""
CONTEXT_SIZE = 11

Modifier = Callable[[FloatArray, FloatArray, int, FloatArray, float], float]
RateWriter = Callable[[FloatArray, FloatArray, int, FloatArray, FloatArray], None]


class Kernels(NamedTuple):
    """A term in the compiled single pixel.

    Each takes (v, y, s, c, x), v the term's parameters in order, y the states, s the row of its first follower, c the
    context, x the value without the term; and returns it with the term.

    light: W on the absorber; capacity: J/K; bridge: K/W; leaving: W from the absorber to the room; wall: rise of the
    bridge's far end, K; rates: writes to x, dy/dt; lifts, pushes: the gas's rise that lifts the membrane, that pushes
    a finger, K; reads: the rise that the thermometer shows, K; lag: the thermometer's, s
    """

    optical_power: Modifier | None = None
    heat_capacity: Modifier | None = None
    bridge_resistance: Modifier | None = None
    heat_loss: Modifier | None = None
    wall_rise: Modifier | None = None
    rates: RateWriter | None = None
    membrane_drive: Modifier | None = None
    force_drive: Modifier | None = None
    sensor_reading: Modifier | None = None
    sensor_lag: Modifier | None = None


@dataclass(frozen=True)
class TermParameter:
    """A parameter of a term: its unit, where a fit begins, the plausible range, and where the range comes from."""

    name: str
    unit: str
    default: float
    low: float
    high: float
    source: str


class StateView(NamedTuple):
    """What a term sees: rises above ambient by the names of states, each [p]; ambient; the lattice."""

    rise_k: Mapping[str, FloatArray]
    ambient_k: float
    neighbours: Neighbours | None

    def wall_k(self) -> FloatArray:
        """Walls' rise, zero where no term warms them: [p]."""
        return self.rise_k.get("wall_k", np.zeros_like(self.rise_k["absorber_k"]))


class OperatingEnvelope(NamedTuple):
    """The most there is: one absorber's rise; all absorbers' rises together, one beam's, K; the laser's power, W."""

    absorber_k: float
    summed_absorbers_k: float
    full_w: float


class HeatGainBound(NamedTuple):
    """The most a term adds to what warms.

    Factors on the power absorbed and on the heat capacity of a hot absorber; and what warms everything otherwise, K.
    """

    power_factor: float = 1.0
    capacity_factor: float = 1.0
    uniform_rise_k: float = 0.0


NO_HEAT_GAIN = HeatGainBound()


@dataclass
class HeatFlows:
    """Heat on its way, W, each [p]: into a node, by its name; and to ambient for good."""

    into_w: dict[str, FloatArray] = field(default_factory=dict)
    lost_w: FloatArray | float = 0.0

    def add_flow(self, source: str | None, target: str | None, power_w: FloatArray) -> None:
        """Let heat flow from a node to another; None is ambient, at either end."""
        for node, gained_w in ((source, -power_w), (target, power_w)):
            if node is None:
                self.lost_w = self.lost_w + gained_w
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
    requires: tuple[str, ...] = ()
    heat_nodes: Mapping[str, str] = {}
    followers: tuple[str, ...] = ()
    kernels: Kernels = Kernels()
    signature: str = ""
    varies_between_runs: bool = False
    is_fast: bool = False
    cannot_add_heat: bool = False

    @property
    def is_display_term(self) -> bool:
        """Whether the term acts in the model of a whole display, not in the compiled single pixel alone."""
        hooks = ("bridge_k_per_w", "add_flows", "rates_k_per_s", "displacement_m", "force_n")
        return any(getattr(type(self), name) is not getattr(Term, name) for name in hooks)

    @property
    def is_pixel_term(self) -> bool:
        """Whether nothing of the term is lost in the compiled single pixel."""
        return any(self.kernels) or not self.is_display_term

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound | None:
        """What a bound on heat must add for the term; None where it cannot say, and the limiter refuses the term."""
        return NO_HEAT_GAIN if self.cannot_add_heat else None

    def bridge_k_per_w(self, values: TermValues, view: StateView, r_k_per_w: FloatArray) -> FloatArray:
        """The bridge's resistance, given what it would be without the term: [p]."""
        return r_k_per_w

    def add_flows(self, values: TermValues, view: StateView, flows: HeatFlows) -> None:
        """Add heat flows between nodes and to ambient."""

    def rates_k_per_s(self, values: TermValues, view: StateView) -> dict[str, FloatArray]:
        """How fast the term's followers move: name → [p]."""
        return {}

    def displacement_m(self, values: TermValues, view: StateView, displacement_m: FloatArray) -> FloatArray:
        """The membrane's displacement, given what it would be without the term: [p]."""
        return displacement_m

    def force_n(self, values: TermValues, view: StateView, force_n: FloatArray) -> FloatArray:
        """Blocked force, given what it would be without the term: [p]."""
        return force_n
