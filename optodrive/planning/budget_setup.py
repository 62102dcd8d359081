"""The budget of a configuration: its caps, and the model in use with the uncertainty declared for it."""

from collections.abc import Mapping

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.units import ZERO_CELSIUS_K
from optodrive.device.config import Config
from optodrive.device.field_loader import moves_of
from optodrive.device.neighbours import Neighbours
from optodrive.physics.parameters import ParameterSet, PixelArray
from optodrive.physics.term import NO_WARMING, Most, Values, Warming
from optodrive.physics.terms import known_terms
from optodrive.planning.limiter.budget import Budget, Caps, Mirrors
from optodrive.planning.limiter.worst_case import Declared, Touch, Uncertainty, Walls, heat_bound

BOUNDED = ("bridge_conductivity", "wall_heating", "lateral_conduction", "touch_surface")
"""Terms that the bound on heat counts with."""


def budget_of(config: Config, parameters: ParameterSet, pixels: PixelArray) -> Budget:
    """Caps, bound and mirrors; raises InputError where a bound cannot be given."""
    limits, ambient_c = config.limits, config.ambient_c
    warming = warming_of(parameters, pixels, config)
    base_c = ambient_c + warming.everywhere_k
    for name, cap_c in (
        ("absorber_max_c", limits.absorber_max_c),
        ("wall_max_c", limits.wall_max_c),
        ("touch_max_c", limits.touch_max_c),
    ):
        if cap_c <= base_c:
            raise InputError(
                f"limits.{name}",
                cap_c,
                f"more than {base_c:.1f} °C, to which the terms of {parameters.name} may warm it",
            )
    caps = Caps(
        absorber_k=limits.absorber_max_c - base_c,
        wall_k=limits.wall_max_c - base_c,
        touch_k=limits.touch_max_c - base_c,
        galvo_rad2_per_s4=limits.galvo_acceleration_rms_max_rad_per_s2**2,
        pulse_energy_j=limits.pulse_energy_max_j,
        pulse_width_s=limits.pulse_width_max_s,
        pulse_rest_s=limits.pulse_rest_min_s,
        pixel_mean_w=limits.pixel_mean_power_max_w,
        pixel_window_s=limits.pixel_mean_window_s,
        display_mean_w=limits.display_mean_power_max_w,
        display_window_s=limits.display_mean_window_s,
        least_w=config.least_power_w,
    )
    model = declared(parameters, pixels, Neighbours.of(config.display), ambient_c + ZERO_CELSIUS_K, warming)
    uncertainty = Uncertainty(**limits.uncertainty.model_dump())
    return Budget(caps, heat_bound(model, uncertainty, caps, config.laser.max_power_w), mirrors_of(config))


def mirrors_of(config: Config) -> Mirrors:
    """The mirrors' servo, and the lead that every plan keeps."""
    scanner = config.scanner
    return Mirrors(
        omega_per_s=2.0 * np.pi * scanner.bandwidth_hz,
        damping=scanner.damping,
        delay_s=scanner.delay_s,
        slew_rad_per_s=scanner.slew_rad_per_s,
        lead_s=moves_of(config).lead_us * 1e-6,
        mean_s=config.limits.galvo_mean_s,
        code_rad=scanner.code_rad,
        early_s=config.board.early_s,
    )


def warming_of(parameters: ParameterSet, pixels: PixelArray, config: Config) -> Warming:
    """What all terms together that the bound does not follow add to heat, at the most.

    Raises InputError for a term that may make something warmer by nobody knows how much.
    """
    terms = {key: parameters.term_values(key) for key in parameters.terms}
    cap_k, full_w = config.limits.absorber_max_c - config.ambient_c, config.laser.max_power_w
    light = _added(terms, Most(cap_k, 0.0, full_w))
    c_j_per_k, r_k_per_w = float(pixels.c_j_per_k.max()) * light.capacity, float(pixels.r_k_per_w.max())
    together_k = light.power * float(pixels.epsilon.max()) * full_w * r_k_per_w * _unsure(config, terms, light.capacity)
    everywhere_k = _added(terms, Most(cap_k, together_k, full_w)).everywhere_k
    # Absorbers pass what warms them on to walls and touch surfaces, and hold it back for a while: a little each.
    more = 1.0
    if "wall_heating" in terms:
        more += 2.0 * c_j_per_k / terms["wall_heating"]["capacity"]
    if "touch_surface" in terms:
        touch = terms["touch_surface"]
        more += touch["gas_share"] * r_k_per_w * c_j_per_k / touch["lag"]
    return light._replace(everywhere_k=more * everywhere_k)


def _added(terms: Mapping[str, Values], most: Most) -> Warming:
    power = capacity = 1.0
    everywhere_k = 0.0
    for key in terms:
        if key in BOUNDED:
            continue
        own = known_terms()[key].warming(terms[key], most)
        if own is None:
            raise InputError(
                f"terms.{key}", key, "a term that the limiter's bound holds for: it may warm what is capped"
            )
        power, capacity, everywhere_k = power * own.power, capacity * own.capacity, everywhere_k + own.everywhere_k
    return Warming(power, capacity, everywhere_k)


def _unsure(config: Config, terms: Mapping[str, Values], capacity: float) -> float:
    """By how much more than ε P R all absorbers together may rise: what is declared unsure, and hot bridges.

    Their heat stays below ε P × the longest R C; as rises, divided by the least C.
    """
    unsure = config.limits.uncertainty
    hottest = (config.limits.absorber_max_c + ZERO_CELSIUS_K) / (config.ambient_c + ZERO_CELSIUS_K)
    exponent = terms["bridge_conductivity"]["exponent"] + unsure.exponent if "bridge_conductivity" in terms else 0.0
    spread = (1 + unsure.absorber_capacity) / (1 - unsure.absorber_capacity) * capacity
    return float((1 + unsure.absorbed_power) * (1 + unsure.bridge_resistance) * spread * hottest**exponent)


def declared(
    parameters: ParameterSet,
    pixels: PixelArray,
    neighbours: Neighbours,
    ambient_k: float,
    warming: Warming = NO_WARMING,
) -> Declared:
    """What the limiter takes from a parameter set: everything that moves heat."""
    terms = {key: parameters.term_values(key) for key in parameters.terms}
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
        epsilon=pixels.epsilon * warming.power,
        r_k_per_w=pixels.r_k_per_w,
        c_j_per_k=pixels.c_j_per_k,
        hot_capacity=warming.capacity,
        warmer_k=warming.everywhere_k,
        tau_g_s=float(pixels.tau_g_s.max()),
        ambient_k=ambient_k,
        exponent=terms.get("bridge_conductivity", {}).get("exponent", 0.0),
        beside=neighbours.beside,
        frame_edges=neighbours.frame_edges,
        walls=walls,
        touch=Touch(touch["gas_share"], touch["wall_share"], touch["lag"]) if touch else None,
    )
