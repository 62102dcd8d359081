"""Worst-case coefficients of the panel, on which all walls and touch surfaces stand, and of values within a range."""

from dataclasses import dataclass
from math import e, log

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity
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


# Each factor 1 / (1 − τ / T) is then at most 4/3. Below that ratio the margins would take most of the caps.
PANEL_LAG_RATIO = 4.0


@dataclass(frozen=True, eq=False)
class PanelBound:
    """Worst-case coefficients of the panel.

    k_per_s: its fastest rise
    """

    k_per_j: FloatArray
    tau_s: FloatArray
    specht_ratio: float
    per_absorber: float
    per_wall: float
    per_touch: float
    k_per_s: float
    floor_k: float


def build_panel_bound(
    model: NominalThermalModel,
    uncertainty: Uncertainty,
    epsilon: float,
    all_power_w: float,
    lag_max_s: float,
    wall_max_j_per_k: float,
    touch_lag_max_s: float,
) -> PanelBound:
    """Bound the panel as if all heat of a pulse arrived at once, and warmed the walls with it.

    all_power_w: power of all stages together; lag_max_s, touch_lag_max_s: largest lags of absorber and touch surface;
    wall_max_j_per_k: largest capacity of a wall with its absorber. Raises InputError if the panel is too fast for them.

    The walls are warmer than the panel on average, because all heat enters through them.

    A node with a time constant τ that follows one that falls no faster than exp(−t / T) exceeds it at most by the
    factor 1 / (1 − τ / T). The same factor covers heat that arrives at the panel later than it is counted.

    The panel also rises by pulses on other pixels, at most at one rate. A wall at its cap over the panel, warmed by
    neighbours that are no hotter, falls meanwhile at least at the rate cap / (R C), which is faster if the cap is above
    a floor.

    A touch surface follows the panel and its share of what gas and wall are above it: the panel as a whole, and more if
    the shares exceed 1.
    """
    panel, walls = model.panel, model.walls
    if panel is None:
        # Time constants of 1 and rises of 0: the kernels need no branch for a display without a panel.
        return PanelBound(np.zeros(2), np.ones(2), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    signs, count = np.array([-1.0, 1.0]), len(model.epsilon)
    capacities = panel.c_j_per_k * (1 + signs * uncertainty.panel_capacity)
    wall_lag_s = 0.0
    if walls is not None:
        # Walls warm with the panel, and on average more: without their capacity a panel with a narrow rim seems to warm
        # several times too fast.
        capacities += count * walls.c_j_per_k * (1 + signs * uncertainty.wall_capacity)
        wall_lag_s = walls.r_k_per_w * (1 + uncertainty.wall_resistance) * wall_max_j_per_k
    tau_s = panel.r_k_per_w * (1 + uncertainty.panel_resistance) * capacities
    gas_lag_s = model.tau_g_s * (1 + uncertainty.gas_lag)
    touch_lag_s = 0.0 if model.touch is None else touch_lag_max_s
    slowest_s = max(lag_max_s, wall_lag_s, touch_lag_s)
    if tau_s[0] < PANEL_LAG_RATIO * slowest_s:
        raise InputError(
            "panel",
            f"a time constant of {format_quantity(float(tau_s[0]), 's')}",
            f"at least {PANEL_LAG_RATIO:g} times that of absorbers, walls and touch surface, "
            f"{format_quantity(slowest_s, 's')}",
        )

    def follow(*lags_s: float) -> float:
        return float(np.prod([1.0 / (1.0 - lag_s / tau_s[0]) for lag_s in lags_s]))

    per_wall, per_absorber = follow(wall_lag_s), follow(wall_lag_s, lag_max_s)
    ratio = specht_ratio(capacities[1] / capacities[0])
    k_per_j = epsilon * per_absorber / capacities
    k_per_s = ratio * float(k_per_j[0]) * all_power_w
    shares = 0.0 if model.touch is None else model.touch.gas_share + model.touch.wall_share
    # At least 1: a membrane whose shares are below 1 is still surrounded by the panel, which a finger touches as well.
    per_panel = max(1.0, shares * (1 + uncertainty.touch_share))
    return PanelBound(
        k_per_j=k_per_j,
        tau_s=tau_s,
        specht_ratio=ratio,
        per_absorber=per_absorber,
        per_wall=per_wall,
        per_touch=per_panel * follow(wall_lag_s, lag_max_s, gas_lag_s, touch_lag_s),
        k_per_s=k_per_s,
        floor_k=per_wall * k_per_s * wall_lag_s,
    )


def specht_ratio(ratio: float) -> float:
    """Return the factor by which a sum of responses (1/c) e^(−t/rc) can exceed its larger value at the ends of c.

    ratio: larger over smaller end of c.

    With s = 1/c each response is s e^(−xs). For s between its ends, with weights linear in s, e^(−xs) is the weighted
    geometric mean of its end values, and no mean of two values exceeds the larger one. s itself exceeds the weighted
    geometric mean of its ends by at most Specht's ratio.
    """
    if ratio == 1.0:
        return 1.0
    return float((ratio - 1) * ratio ** (1 / (ratio - 1)) / (e * log(ratio)))
