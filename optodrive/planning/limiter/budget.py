"""What the limiter counts with: caps, the model's upper corner, the mirrors. Plain numbers and arrays for kernels.

Written apart from `optodrive.physics` on purpose: what checks the limiter must not share its code.
"""

from typing import NamedTuple

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.planning.limiter.caps import CapValues

TOLERANCE = 1e-9
"""Relative excess that floating-point rounding may cause; a larger one is real."""


class HeatBound(NamedTuple):
    """Coefficients of the bound on heat at the upper corner of the declared uncertainty; `corner` makes them.

    epsilon, r_k_per_w, c_low_j_per_k, c_high_j_per_k: [p] the absorber; r at reference temperature
    knot_k, loss_k: [s] chords below the bridge's loss: rise over the wall, and loss × r there
    absorber_wall: how far an absorber may lag above a wall that cools: rise ≤ own rise + this × the wall's bound
    wall_w_per_k: [p] what leaves a wall per kelvin; wall_j_per_k: [2] least and greatest capacity
    wall_k_per_j: [2] rise of a wall per incident joule, all of it at once; wall_spread: see `corner.spread`
    beside: [p, 4] neighbours, −1 for none; side_w_per_k: conductance to one, as counted for the colder of two
    step_s: walls exchange heat at such steps
    touch_lag_s, touch_k_per_j: [2]; touch_per_wall_k: steady touch surface over the wall's bound; touch_spread
    least_k_per_w: [p] steady rise of an absorber over its wall per incident watt, at least; least_rate_per_s: [p, 2]
    towards it while it warms, and while it cools; lost_k: by how much neighbours' heat may bring the rise below that
    wall_flight, touch_flight: kelvin that wall and touch surface are below their bounds for each kelvin an absorber is
    over its wall, by heat that counts as arrived; touch_lost_k: by how much less, through the gas
    power_max_w: the strongest pulse there can be
    """

    epsilon: FloatArray
    r_k_per_w: FloatArray
    c_low_j_per_k: FloatArray
    c_high_j_per_k: FloatArray
    knot_k: FloatArray
    loss_k: FloatArray
    absorber_wall_factor: float
    wall_w_per_k: FloatArray
    wall_j_per_k: FloatArray
    wall_k_per_j: FloatArray
    wall_specht_ratio: float
    neighbours: IntArray
    lateral_w_per_k: float
    exchange_step_s: float
    touch_lag_s: FloatArray
    touch_k_per_j: FloatArray
    touch_per_wall_k: float
    touch_specht_ratio: float
    lower_bound_k_per_w: FloatArray
    lower_bound_rate_per_s: FloatArray
    deficit_k: float
    wall_transit_credit: float
    touch_transit_credit: float
    touch_deficit_k: float
    power_max_w: float


class GalvoModel(NamedTuple):
    """Servos of the second order, natural frequency omega_per_s; delay_s after a command their targets run at the slew.

    lead_s: from a plan's begin to its first pulse at least; mean_s: time constant of the mean
    code_rad: one step of the converter, by which a move may come out longer
    early_s: by how much two times of a plan may come nearer to each other on their way to points
    """

    omega_rad_per_s: float
    damping: float
    delay_s: float
    slew_rad_per_s: float
    lead_in_s: float
    averaging_s: float
    code_step_rad: float
    interval_shrink_s: float


class Budget(NamedTuple):
    """Everything a plan is held against."""

    caps: CapValues
    heat: HeatBound
    galvo: GalvoModel
