"""Nominal models and worst parameters of the shipped displays, for the true display of `thermal_display`."""

from displays import DISPLAYS
from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.device.panel import Neighbours
from optodrive.physics.parameters import load_parameters
from optodrive.planning.budget_setup import build_nominal_model, build_nominal_panel
from optodrive.planning.limiter.panel_bound import Uncertainty
from reference_models.thermal_display import upper_factors


def build_model(name):
    display = DISPLAYS[name]
    parameters, config = load_parameters(display.config.pixel_model.parameters), display.config
    neighbours, ambient_k = Neighbours.from_display(config.display), config.ambient_c + ZERO_CELSIUS_K
    panel = build_nominal_panel(config, parameters, display.pixels)
    return build_nominal_model(parameters, display.pixels, neighbours, ambient_k, panel=panel)


def build_worst_factors(name, capacity_sign):
    """Return the parameters with the highest steady temperatures, and the smallest or the largest capacities."""
    unsure = Uncertainty(**DISPLAYS[name].config.limits.uncertainty.model_dump())
    capacities = ("absorber_capacity", "wall_capacity", "touch_lag", "gas_lag", "panel_capacity")
    return upper_factors(unsure) | {key: 1 + capacity_sign * getattr(unsure, key) for key in capacities}
