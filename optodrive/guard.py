"""The budget of a configuration: its caps, and the model in use with the uncertainty declared for it."""

import numpy as np

from optodrive.config import Config
from optodrive.errors import InputError
from optodrive.limit.budget import Budget, Caps, Mirrors
from optodrive.limit.corner import Declared, Touch, Uncertainty, Walls, heat_bound
from optodrive.neighbours import Neighbours
from optodrive.physics.parameters import ParameterSet, PixelArray
from optodrive.physics.terms import known_terms
from optodrive.units import ZERO_CELSIUS_K

BOUNDED = ("bridge_conductivity", "wall_heating", "lateral_conduction", "touch_surface")
"""Terms that the bound on heat counts with."""
ANGLE_CODES = 32_768
"""Steps of the converter over a mirror's range to one side."""


def budget_of(config: Config, parameters: ParameterSet, pixels: PixelArray) -> Budget:
    """Caps, bound and mirrors; raises InputError where a bound cannot be given."""
    limits, scanner, ambient_c = config.limits, config.scanner, config.ambient_c
    caps = Caps(
        absorber_k=limits.absorber_max_c - ambient_c,
        wall_k=limits.wall_max_c - ambient_c,
        touch_k=limits.touch_max_c - ambient_c,
        galvo_rad2_per_s4=limits.galvo_acceleration_rms_max_rad_per_s2**2,
        pulse_energy_j=limits.pulse_energy_max_j,
        pulse_width_s=limits.pulse_width_max_s,
        pulse_rest_s=limits.pulse_rest_min_s,
        pixel_mean_w=limits.pixel_mean_power_max_w,
        pixel_window_s=limits.pixel_mean_window_s,
        display_mean_w=limits.display_mean_power_max_w,
        display_window_s=limits.display_mean_window_s,
    )
    model = declared(parameters, pixels, Neighbours.of(config.display), ambient_c + ZERO_CELSIUS_K)
    uncertainty = Uncertainty(**limits.uncertainty.model_dump())
    mirrors = Mirrors(
        settle_s=scanner.settle_s,
        slew_rad_per_s=scanner.slew_rad_per_s,
        mean_s=limits.galvo_mean_s,
        code_rad=scanner.range_rad / ANGLE_CODES,
    )
    return Budget(caps, heat_bound(model, uncertainty, caps, config.laser.max_power_w), mirrors)


def declared(parameters: ParameterSet, pixels: PixelArray, neighbours: Neighbours, ambient_k: float) -> Declared:
    """What the limiter takes from a parameter set: everything that moves heat.

    Raises InputError for a term that may make something warmer and that the bound does not know.
    """
    for key in parameters.terms:
        if key not in BOUNDED and not known_terms()[key].never_warmer:
            raise InputError(
                f"terms.{key}", key, "a term that the limiter's bound holds for: it may warm what is capped"
            )
    terms = {key: {name: item.value for name, item in values.items()} for key, values in parameters.terms.items()}
    wall, side, touch = (terms.get(key) for key in ("wall_heating", "lateral_conduction", "touch_surface"))
    walls = None
    if wall is not None:
        walls = Walls(
            r_k_per_w=wall["resistance"],
            c_j_per_k=wall["capacity"],
            side_k_per_w=side["resistance"] if side else np.inf,
            frame_k_per_w=side["frame_resistance"] if side else np.inf,
        )
    return Declared(
        epsilon=pixels.epsilon,
        r_k_per_w=pixels.r_k_per_w,
        c_j_per_k=pixels.c_j_per_k,
        tau_g_s=float(pixels.tau_g_s.max()),
        ambient_k=ambient_k,
        exponent=terms.get("bridge_conductivity", {}).get("exponent", 0.0),
        beside=neighbours.beside,
        frame_edges=neighbours.frame_edges,
        walls=walls,
        touch=Touch(touch["gas_share"], touch["wall_share"], touch["lag"]) if touch else None,
    )
