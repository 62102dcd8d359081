"""Coefficients of the limiter: caps, worst-case thermal model and galvo model, as numbers and arrays for kernels.

The limiter shares no code with `optodrive.physics`, because tests compare the two.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.planning.limiter.caps import CapValues

TOLERANCE = 1e-9
"""Relative excess that floating-point rounding may cause; a larger one is real."""


class HeatBound(NamedTuple):
    """Worst-case coefficients of the thermal bound over the declared uncertainty. `build_heat_bound` computes them.

    Absorber:
    epsilon, r_k_per_w, c_low_j_per_k, c_high_j_per_k: [p] absorbed fraction, bridge resistance at the reference
    temperature, smallest and largest heat capacity
    knot_k, loss_k: [s] chords below the bridge's loss: rise over the wall, and loss × r at that rise
    absorber_wall_factor: absorber rise ≤ its rise over the wall + this factor × the wall's bound

    Wall:
    wall_w_per_k: [p] conductance to the surroundings; wall_j_per_k: [2] smallest and largest capacity
    wall_k_per_j: [2] rise per incident joule, delivered at once; wall_specht_ratio: see `specht.specht_ratio`
    neighbours: [p, 4] neighbouring pixels, −1 for none
    lateral_w_per_k: conductance to a neighbour, as counted for the colder of two walls
    exchange_step_s: interval at which walls exchange heat

    Touch surface:
    touch_lag_s, touch_k_per_j: [2] smallest and largest lag, and rise per incident joule
    touch_per_wall_k: steady rise of the touch surface over the wall's bound; touch_specht_ratio

    Panel:
    panel_k_per_j, panel_tau_s: [2] rise per incident joule, delivered at once, and time constant, for the smallest and
    the largest capacity; panel_specht_ratio
    absorber_per_panel, wall_per_panel, touch_per_panel: rise of each by the panel's bound, which they follow with a lag
    panel_k_per_s: fastest rise of the panel, by pulses of all stages; panel_floor_k: smallest cap of a wall over the
    panel from which it cools faster than that

    In-transit heat credit:
    lower_bound_k_per_w: [p] lower bound on the steady rise of an absorber over its wall per incident watt
    lower_bound_rate_per_s: [p, 2] rate towards it, for warming and for cooling
    deficit_k: largest amount by which heat from neighbours reduces the rise below that bound
    wall_transit_credit, touch_transit_credit: difference between the bound of the wall or touch surface, which counts
    the heat as arrived, and its temperature, per kelvin of the absorber's rise over its wall
    touch_deficit_k: reduction of the touch surface's credit by the gas

    power_max_w: [k] largest power of a pulse of each stage
    skew_s: largest difference between the clocks of two stages
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
    panel_k_per_j: FloatArray
    panel_tau_s: FloatArray
    panel_specht_ratio: float
    absorber_per_panel: float
    wall_per_panel: float
    touch_per_panel: float
    panel_k_per_s: float
    panel_floor_k: float
    lower_bound_k_per_w: FloatArray
    lower_bound_rate_per_s: FloatArray
    deficit_k: float
    wall_transit_credit: float
    touch_transit_credit: float
    touch_deficit_k: float
    power_max_w: FloatArray
    skew_s: float


class GalvoModel(NamedTuple):
    """Second-order servos of both mirrors. Their targets follow a command after delay_s, at the slew limit.

    omega_rad_per_s: natural frequency; lead_in_s: smallest time from the start of a plan to its first pulse
    averaging_s: time constant of the mean-square acceleration
    rad_per_code: one converter step, by which a move can be longer
    timing_slack_s: largest reduction of an interval between two planned times by quantisation
    early_s: largest time by which a step is sent before the pulse before it ends
    """

    omega_rad_per_s: float
    damping: float
    delay_s: float
    slew_rad_per_s: float
    lead_in_s: float
    averaging_s: float
    rad_per_code: float
    timing_slack_s: float
    early_s: float


class GalvoModels(NamedTuple):
    """`GalvoModel` of every stage: its fields as arrays [k]."""

    omega_rad_per_s: FloatArray
    damping: FloatArray
    delay_s: FloatArray
    slew_rad_per_s: FloatArray
    lead_in_s: FloatArray
    averaging_s: FloatArray
    rad_per_code: FloatArray
    timing_slack_s: FloatArray
    early_s: FloatArray

    @classmethod
    def from_models(cls, *models: GalvoModel) -> "GalvoModels":
        """Return the models of all stages, in their order."""
        return cls(*(np.array(column, dtype=np.float64) for column in zip(*models, strict=True)))


@kernel
def select_galvo(galvos: GalvoModels, stage: int) -> GalvoModel:
    """Return the model of one stage."""
    return GalvoModel(
        galvos.omega_rad_per_s[stage],
        galvos.damping[stage],
        galvos.delay_s[stage],
        galvos.slew_rad_per_s[stage],
        galvos.lead_in_s[stage],
        galvos.averaging_s[stage],
        galvos.rad_per_code[stage],
        galvos.timing_slack_s[stage],
        galvos.early_s[stage],
    )


class Budget(NamedTuple):
    """All coefficients that the limiter needs.

    pwm_period_s, min_power_w: [k] period of each stage's laser, and power of its weakest pulse; weaker ones are dark
    is_proportional: [k] whether a laser emits its full power for its duty of each period, and nothing for the rest
    """

    caps: CapValues
    heat: HeatBound
    galvos: GalvoModels
    pwm_period_s: FloatArray
    min_power_w: FloatArray
    is_proportional: BoolArray
