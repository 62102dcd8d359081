"""Nominal parameters of a display and their declared uncertainty, from which the thermal bound is made."""

from dataclasses import dataclass

from optodrive.core.types.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Uncertainty:
    """Declared relative half-widths of the parameters. The exponent's half-width is absolute."""

    absorbed_power: float
    bridge_resistance: float
    absorber_capacity: float
    exponent: float
    gas_lag: float
    wall_resistance: float
    wall_capacity: float
    side_resistance: float
    touch_share: float
    touch_lag: float
    panel_resistance: float
    panel_capacity: float


@dataclass(frozen=True, eq=False)
class NominalWalls:
    """One wall node per pixel: resistances to surroundings, neighbour and frame (infinite: none), and capacity."""

    r_k_per_w: float
    c_j_per_k: float
    lateral_k_per_w: float
    frame_k_per_w: float


@dataclass(frozen=True)
class NominalTouch:
    """The touch surface: its fractions of the gas's and of the wall's rise over the panel, and its lag."""

    gas_share: float
    wall_share: float
    lag_s: float


@dataclass(frozen=True)
class NominalPanel:
    """The panel, to which all walls lose their heat: resistance to the room, and capacity without the walls'.

    Without walls the absorbers lose theirs to it.
    """

    r_k_per_w: float
    c_j_per_k: float


@dataclass(frozen=True, eq=False)
class NominalThermalModel:
    """Nominal parameters of the thermal model.

    epsilon, r_k_per_w, c_j_per_k: [p] absorbed fraction, bridge resistance and heat capacity of the absorber
    exponent: n in R = R₀ (T / T₀)ⁿ, with the bridge's mean temperature T
    neighbours: [p, 4] neighbouring pixels, −1 for none; frame_edges: [p] number of edges at the frame
    walls, touch, panel: None if the model has no such node; without a panel the surroundings stay at ambient
    hot_capacity_factor: factor by which the capacity of a hot absorber may exceed C
    delay_factor: factor by which the time constant of heat that leaves an absorber may exceed R C
    extra_rise_k: rise by terms outside the bound, already subtracted from the caps
    """

    epsilon: FloatArray
    r_k_per_w: FloatArray
    c_j_per_k: FloatArray
    tau_g_s: float
    ambient_k: float
    exponent: float
    neighbours: IntArray
    frame_edges: IntArray
    walls: NominalWalls | None
    touch: NominalTouch | None
    panel: NominalPanel | None = None
    hot_capacity_factor: float = 1.0
    delay_factor: float = 1.0
    extra_rise_k: float = 0.0
