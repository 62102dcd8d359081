"""Terms of heat, where it is stored and where it goes.

- Bridge conductivity: graphite conducts less heat when hot, so the bridge's resistance rises with temperature.
- Heat capacity of graphite that increases from 0.71 to 1.12 J/(g K) between 300 and 450 K.
- Radiation: the hot absorber radiates to the room.
- Heating of the wall at the bridge's far end, which cools slowly to its surroundings.
- Lateral conduction: neighbouring walls exchange heat, and the frame cools the rim.
- Neighbour crosstalk: the wall warms with the neighbouring absorbers.
- Heating of the whole panel, the surroundings of all walls, by the light on every pixel.
- Touch surface: the membrane's outer side, where the finger is, follows the gas below and the wall around it.
"""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import (
    ABSORBER,
    AMBIENT_K,
    BRIDGE_FLOW_W,
    FAR_END_K,
    NEIGHBOUR,
    PANEL_HELD,
    POWER_W,
    WALL,
    HeatGainBound,
    Kernels,
    OperatingEnvelope,
    Term,
    TermValues,
    add_follower,
)


@kernel
def bridge_conductivity_bridge_resistance(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the resistance by (T / T₀)ⁿ with T the mean of the bridge's two ends."""
    mean_k = c[AMBIENT_K] + 0.5 * (y[ABSORBER] + c[FAR_END_K])
    return float(x * (mean_k / c[AMBIENT_K]) ** v[0])


class BridgeConductivity(Term):
    """R = R₀ (T / T₀)ⁿ with T the mean of absorber and wall and T₀ ambient, where n = 1 is k ~ 1/T (Text S2)."""

    key = "bridge_conductivity"
    label = "the bridges conduct less heat when hot"
    parameters = (TermParameter("exponent", "1", 0.5, 0.0, 1.3, "k_xy = 3.6e5 / T is 1 (Text S2)"),)
    kernels = Kernels(bridge_resistance=bridge_conductivity_bridge_resistance)
    varies_between_runs = True
    signature = "plateaus at several powers"


@kernel
def heat_capacity_heat_capacity(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the absorber's heat capacity by 1 + slope · θ."""
    return float(x * (1.0 + v[0] * y[ABSORBER]))


class HeatCapacity(Term):
    """C = C₀ (1 + slope · θ), J/K."""

    key = "heat_capacity"
    label = "the absorber stores more heat when hot"
    parameters = (
        TermParameter(
            "slope",
            "1/K",
            2e-3,
            0.0,
            4e-3,
            "c_p of graphite, 300 to 450 K: 3.9e-3; lower if other material shares the heat",
        ),
    )
    kernels = Kernels(heat_capacity=heat_capacity_heat_capacity)
    signature = "initial slopes at several powers, with unchanged plateaus"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the capacity of the hottest absorber over C₀. The capacity is never below C₀."""
        return HeatGainBound(capacity_factor=1.0 + values["slope"] * envelope.absorber_k)


STEFAN_BOLTZMANN = 5.670374e-8
"""W/(m² K⁴)."""


@kernel
def radiation_heat_loss(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add the radiated power, W."""
    warm_k = c[AMBIENT_K] + y[ABSORBER]
    return float(x + v[0] * STEFAN_BOLTZMANN * (warm_k**4 - c[AMBIENT_K] ** 4))


class Radiation(Term):
    """εA σ (T⁴ − T₀⁴), W, from the absorber to ambient."""

    key = "radiation"
    label = "the hot absorber radiates"
    parameters = (
        TermParameter(
            "emitting_area",
            "m^2",
            4e-6,
            1e-8,
            2e-5,
            "both faces of a 2 mm x 1.5 mm absorber and its bridges, emissivity 0.5 to 0.9",
        ),
    )
    kernels = Kernels(heat_loss=radiation_heat_loss)
    varies_between_runs = True
    cannot_add_heat = True
    signature = "hot pixels with narrow bridges, whose cooling slows down"


SHORTEST_WALL_S = 0.1
"""Shortest time constant of a wall. What follows the absorber faster is another part of the pixel, and no wall."""


@kernel
def wall_heating_rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Heat the wall by the bridge's flow and cool it to its surroundings, in no less than SHORTEST_WALL_S."""
    x[WALL] = (c[BRIDGE_FLOW_W] - y[WALL] / v[0]) / max(v[1], SHORTEST_WALL_S / v[0])


def compute_capacity(values: TermValues) -> float:
    """Return the heat capacity that gives a wall no shorter time constant than SHORTEST_WALL_S, J/K."""
    return max(values["capacity"], SHORTEST_WALL_S / values["resistance"])


class WallHeating(Term):
    """C dw/dt = bridge flow − w / R, with R C of 0.1 s or more. Bridge and gas see the wall's rise w."""

    key = "wall_heating"
    label = "the walls heat up"
    parameters = (
        TermParameter(
            "resistance",
            "K/W",
            20.0,
            0.05,
            40.0,
            "a cell of the laminate to its surroundings, by its materials",
            starts=(8.0,),
        ),
        TermParameter(
            "capacity", "J/K", 0.06, 2.5e-3, 200.0, "0.1 to 10 s with the resistance", starts=(0.02, 0.08, 0.3, 1.0)
        ),
    )
    states = (WALL,)
    kernels = Kernels(rates=wall_heating_rates)
    signature = "trains of several seconds and the slow tail after them"


class LateralConduction(Term):
    """(w − w') / resistance between neighbours, w / frame_resistance at each edge on the frame.

    The limiter's bound on heat accounts for it; the pixels that heights are planned with are uncoupled.
    """

    key = "lateral_conduction"
    label = "neighbouring walls exchange heat"
    requires = ("wall_heating",)
    parameters = (
        TermParameter("resistance", "K/W", 430.0, 40.0, 10_000.0, "neighbours rise by 0.002 to 0.1 of a wall's rise"),
        TermParameter("frame_resistance", "K/W", 430.0, 40.0, 10_000.0, "as between neighbours"),
    )
    in_pixel = False


@kernel
def neighbour_crosstalk_rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let the wall follow a share of the neighbour's rise with a first-order lag."""
    x[s] = (v[0] * y[NEIGHBOUR] - y[s]) / v[1]


class NeighbourCrosstalk(Term):
    """lag · dn/dt = share · θ_neighbour − n, with n the rise of the bridge's far end."""

    key = "neighbour_crosstalk"
    label = "pixels heat their neighbours"
    parameters = (
        TermParameter("share", "1", 0.02, 0.0, 0.15, "a wall's rise over its neighbour's rise, 0.002 to 0.1"),
        TermParameter("lag", "s", 0.02, 2.5e-3, 1.0, "conduction through one cell's wall", starts=(0.003, 0.03, 0.2)),
    )
    followers = ("crosstalk_k",)
    kernels = Kernels(rates=neighbour_crosstalk_rates, wall_rise=add_follower)
    couples_neighbours = True
    signature = "runs in which only a neighbour is illuminated"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return a rise of everything as if all heat of the display were next to every pixel."""
        return HeatGainBound(uniform_rise_k=values["share"] * envelope.summed_absorbers_k)

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return the default hypothesis if the recording has pulses on neighbours of a measured pixel."""
        return super().build_hypotheses(scope) if scope.has_neighbour_pulses else []


@kernel
def panel_heating_rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Heat the panel by a share of the light and cool it to the room, unless it is held."""
    x[s] = 0.0 if c[PANEL_HELD] > 0.0 else (v[2] * c[POWER_W] - y[s] / v[0]) / v[1]


class PanelHeating(Term):
    """C dp/dt = share · P − p / R, with P the light on any pixel. Bridge and gas see the panel's rise p."""

    key = "panel_heating"
    label = "the whole panel heats up"
    parameters = (
        TermParameter("resistance", "K/W", 5.0, 0.05, 200.0, "a panel of 10 × 10 to 300 × 300 mm² in still air"),
        TermParameter(
            "capacity",
            "J/K",
            40.0,
            1.0,
            5000.0,
            "such a panel of acrylic and polystyrene",
            starts=(4.0, 20.0, 100.0, 500.0),
        ),
        TermParameter("share", "1", 0.65, 0.3, 1.0, "the light that becomes heat: the absorptance", is_shape=True),
    )
    followers = ("panel_k",)
    has_panel_state = True
    kernels = Kernels(rates=panel_heating_rates, wall_rise=add_follower)
    signature = "a rise of all pixels, also those without light, over minutes of light on any"

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one hypothesis, whose share is the default, if light on one pixel can show on another."""
        if len(scope.illuminated | frozenset(scope.pixels)) < 2:
            return []
        (whole,) = super().build_hypotheses(scope)
        return [Hypothesis(self.key, self.key, whole.starts, (self.free("resistance"), self.free("capacity")))]


class TouchSurface(Term):
    """lag · ds/dt = p + gas_share · (γ − p) + wall_share · (w − p) − s, with p the panel's rise.

    The limiter's bound on heat accounts for it; neither displacement nor any recorded signal depends on it.
    """

    key = "touch_surface"
    label = "the touch surface warms"
    parameters = (
        TermParameter("gas_share", "1", 0.3, 0.05, 0.6, "conduction through gas, membrane and finger in series"),
        TermParameter("wall_share", "1", 0.4, 0.1, 0.6, "conduction in the membrane to its rim"),
        TermParameter("lag", "s", 1.2, 0.3, 5.0, "heat capacity of the membrane over those conductances"),
    )
    in_pixel = False
