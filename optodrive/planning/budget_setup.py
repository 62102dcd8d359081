"""Build the limiter's budget from a configuration: caps, worst-case thermal model and galvo model."""

from collections.abc import Mapping
from math import exp, pi, sqrt

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.device.config import Config
from optodrive.device.field_loader import build_settling_table
from optodrive.device.panel import Neighbours, complete_panel
from optodrive.physics.parameters import ParameterSet, PixelArray
from optodrive.physics.term import NO_HEAT_GAIN, HeatGainBound, OperatingEnvelope, TermValues
from optodrive.physics.term_plug_ins import changes_heat
from optodrive.physics.terms import all_terms, load_plug_ins
from optodrive.physics.terms.thermal import compute_capacity
from optodrive.planning.limiter.budget import Budget, GalvoModel, GalvoModels, HeatBound
from optodrive.planning.limiter.caps import CAPS, CapScale, CapValues
from optodrive.planning.limiter.panel_bound import (
    NominalPanel,
    NominalThermalModel,
    NominalTouch,
    NominalWalls,
    Uncertainty,
)
from optodrive.planning.limiter.worst_case import build_heat_bound

BOUNDED_TERMS = ("bridge_conductivity", "wall_heating", "lateral_conduction", "touch_surface", "panel_heating")
"""Terms that the thermal bound models explicitly."""


def build_budget(config: Config, parameters: ParameterSet, pixels: PixelArray) -> Budget:
    """Build the budget. Raise InputError if a cap is not above its base temperature or a term has no bound."""
    limits, ambient_c, stages = config.limits, config.ambient_c, config.list_stage_configs()
    heat_gain = compute_heat_gain_bound(parameters, pixels, config)
    base_c = ambient_c + heat_gain.uniform_rise_k
    values = {}
    for cap in CAPS:
        setting = getattr(limits, cap.setting)
        if cap.scale is CapScale.TEMPERATURE and setting <= base_c:
            raise InputError(
                f"limits.{cap.setting}",
                setting,
                f"more than {base_c:.1f} °C, to which the terms of {parameters.name} may warm it",
            )
        # By the table: a new cap needs nothing here, and a field without a setting fails at once in `CapValues`.
        values[cap.field] = cap.scale.to_value(setting, base_c)
    caps = CapValues(
        **values,
        pulse_gap_s=limits.pulse_gap_min_s,
        pixel_window_s=limits.pixel_mean_window_s,
        display_window_s=limits.display_mean_window_s,
    )
    panel = build_nominal_panel(config, parameters, pixels)
    neighbours = Neighbours.from_display(config.display)
    model = build_nominal_model(parameters, pixels, neighbours, ambient_c + ZERO_CELSIUS_K, heat_gain, panel)
    uncertainty = Uncertainty(**limits.uncertainty.model_dump())
    # One board keeps its own order: its pulses are as far apart as planned, however wrong its clock.
    skew_s = limits.stage_skew_max_s if len(stages) > 1 else 0.0
    powers_w = (stage.laser.max_power_w for stage in stages)
    heat = build_heat_bound(model, uncertainty, caps, *powers_w, skew_s=skew_s)
    late_k = heat_gain.absorber_age_s * compute_fastest_rise_k_per_s(heat, caps)
    if not late_k < caps.absorber_k:
        expected = f"more than {base_c + late_k:.1f} °C, to which the terms of {parameters.name} may warm it"
        raise InputError("limits.absorber_max_c", limits.absorber_max_c, expected)
    # After the bound was built: with the higher cap its chords reach further, which is no looser.
    caps = caps._replace(absorber_k=caps.absorber_k - late_k)
    galvos = [build_galvo_model(stage) for stage in stages]
    check_galvo_cap(limits.galvo_acceleration_rms_max_rad_per_s2, galvos)
    pwm_period_s = np.array([1.0 / stage.laser.width_steps_hz for stage in stages])
    min_power_w = np.array([stage.min_power_w for stage in stages])
    is_proportional = np.array([not stage.laser.curve for stage in stages])
    return Budget(caps, heat, GalvoModels.from_models(*galvos), pwm_period_s, min_power_w, is_proportional)


def compute_fastest_rise_k_per_s(heat: HeatBound, caps: CapValues) -> float:
    """Return the fastest rise of a wall on its panel, K/s, by light and neighbours."""
    wall_k_per_s = heat.wall_specht_ratio * float(heat.wall_k_per_j[0] * heat.power_max_w.sum())
    lateral_k_per_s = 4.0 * heat.lateral_w_per_k * min(caps.wall_k, caps.touch_k) / float(heat.wall_j_per_k[0])
    return wall_k_per_s + lateral_k_per_s + heat.absorber_per_panel * heat.panel_k_per_s


def compute_long_move_load(galvo: GalvoModel) -> float:
    """Return the root mean square of the acceleration after one long move, rad/s², as the galvo load counts it.

    Not by its kernel: a check of a configuration compiles none.
    """
    ratio = galvo.damping / sqrt(1.0 - galvo.damping**2)
    energy = galvo.slew_rad_per_s**2 * galvo.omega_rad_per_s / (2.0 * galvo.damping) * (1.0 + exp(-pi * ratio))
    return sqrt(energy / galvo.averaging_s)


def check_galvo_cap(cap_rad_per_s2: float, galvos: list[GalvoModel]) -> None:
    """Raise InputError for a cap below the load of one long move, and of the next one, for which it always leaves room.

    Under such a cap no pulse fits at any time.
    """
    needed_rad_per_s2 = sqrt(2.0) * max(map(compute_long_move_load, galvos))
    if cap_rad_per_s2 < needed_rad_per_s2:
        expected = f"at least {needed_rad_per_s2:.3g}, the load of two long moves within galvo_mean_s"
        raise InputError("limits.galvo_acceleration_rms_max_rad_per_s2", cap_rad_per_s2, expected)


def build_nominal_panel(config: Config, parameters: ParameterSet, pixels: PixelArray) -> NominalPanel:
    """Build the panel without the walls. Raise InputError for less capacity than theirs.

    A parameter set with panel_heating states it, else the configuration does. The bound heats it by what the absorbers
    absorb: where the term has a larger share, resistance and capacity stand for the larger heat.
    """
    walls_j_per_k = 0.0
    if "wall_heating" in parameters.terms:
        walls_j_per_k = len(pixels) * compute_capacity(parameters.term_values("wall_heating"))
    if "panel_heating" in parameters.terms:
        values, where = parameters.term_values("panel_heating"), "terms.panel_heating.capacity"
        # The bound counts absorbed light only; a term by which the panel gets more is made up for by a panel that warms
        # as much more.
        more = max(1.0, values["share"] / float(pixels.epsilon.min()))
        resistance_k_per_w, capacity_j_per_k = values["resistance"] * more, values["capacity"] / more
    else:
        panel, where = complete_panel(config), "panel.capacity_j_per_k"
        resistance_k_per_w, capacity_j_per_k = panel.resistance_k_per_w, panel.capacity_j_per_k
    if capacity_j_per_k <= walls_j_per_k:
        expected = f"more than {walls_j_per_k:.3g}, the capacity of the walls of {len(pixels)} pixels"
        raise InputError(where, float(f"{capacity_j_per_k:.3g}"), expected)
    return NominalPanel(resistance_k_per_w, capacity_j_per_k - walls_j_per_k)


def build_galvo_model(config: Config) -> GalvoModel:
    """Build the model of the servos of the only stage, with the lead-in that its plans keep."""
    scanner, settling = config.scanner, build_settling_table(config)
    return GalvoModel(
        omega_rad_per_s=2.0 * np.pi * scanner.bandwidth_hz,
        damping=scanner.damping,
        delay_s=scanner.delay_s,
        slew_rad_per_s=scanner.slew_rad_per_s,
        lead_in_s=settling.lead_in_us * 1e-6,
        averaging_s=config.limits.galvo_mean_s,
        rad_per_code=scanner.rad_per_code,
        timing_slack_s=config.board.timing_slack_s,
        early_s=settling.early_points * config.board.point_max_s if settling.early_points else 0.0,
    )


def compute_heat_gain_bound(parameters: ParameterSet, pixels: PixelArray, config: Config) -> HeatGainBound:
    """Bound the heat that all terms outside the thermal bound add together.

    Raises InputError for a term without such a bound.
    """
    terms = {key: parameters.term_values(key) for key in parameters.term_keys}
    powers_w = [stage.laser.max_power_w for stage in config.list_stage_configs()]
    r_k_per_w = float(pixels.r_k_per_w.max())
    envelope = OperatingEnvelope(
        config.limits.absorber_max_c - config.ambient_c,
        0.0,
        max(powers_w),
        sum(powers_w),
        r_k_per_w * (1 + config.limits.uncertainty.bridge_resistance) * _compute_bridge_factor(config, terms) ** 2,
        float(pixels.c_j_per_k.min()) * (1 - config.limits.uncertainty.absorber_capacity),
        float(pixels.c_j_per_k.max()) * (1 + config.limits.uncertainty.absorber_capacity),
        float(pixels.tau_g_s.max()) * (1 + config.limits.uncertainty.gas_lag),
        terms.get("touch_surface", {}).get("gas_share", 0.0) * (1 + config.limits.uncertainty.touch_share),
    )
    heat_gain = _combine_heat_gains(terms, envelope)
    c_j_per_k = float(pixels.c_j_per_k.max()) * heat_gain.capacity_factor
    display_rise_k = (
        heat_gain.power_factor
        * float(pixels.epsilon.max())
        * envelope.all_power_w
        * r_k_per_w
        * _compute_uncertainty_factor(config, terms, heat_gain.capacity_factor)
    )
    # Twice: how much absorbers add to each other depends on their sum, which depends on the factors of all terms.
    uniform_rise_k = _combine_heat_gains(terms, envelope._replace(summed_absorbers_k=display_rise_k)).uniform_rise_k
    # A rise of the absorbers also warms walls and touch surfaces, with a delay; each adds a small part.
    factor = 1.0
    if "wall_heating" in terms:
        factor += 2.0 * c_j_per_k / compute_capacity(terms["wall_heating"])
    if "touch_surface" in terms:
        touch = terms["touch_surface"]
        factor += touch["gas_share"] * r_k_per_w * c_j_per_k / touch["lag"]
    return heat_gain._replace(uniform_rise_k=factor * uniform_rise_k)


def _combine_heat_gains(terms: Mapping[str, TermValues], envelope: OperatingEnvelope) -> HeatGainBound:
    """Combine the bounds of all terms outside the thermal bound."""
    power = capacity = delay = 1.0
    uniform_rise_k = absorber_age_s = 0.0
    for key in terms:
        if key in BOUNDED_TERMS:
            continue
        if key in load_plug_ins().found:
            # Its own statements are not tested here, so that a cap may not rest on them.
            if changes_heat(all_terms()[key]):
                expected = (
                    "a term of optodrive, or one without a kernel of light or heat: no test proves another's bound"
                )
                raise InputError(f"terms.{key}", key, expected)
            continue
        term_gain = all_terms()[key].bound_heat_gain(terms[key], envelope)
        if term_gain is None:
            raise InputError(
                f"terms.{key}", key, "a term that the limiter can bound: this one can warm capped nodes without limit"
            )
        power *= term_gain.power_factor
        capacity *= term_gain.capacity_factor
        delay *= term_gain.delay_factor
        uniform_rise_k += term_gain.uniform_rise_k
        absorber_age_s += term_gain.absorber_age_s
    return HeatGainBound(power, capacity, delay, uniform_rise_k, absorber_age_s * capacity)


def _compute_uncertainty_factor(config: Config, terms: Mapping[str, TermValues], capacity: float) -> float:
    """Return the factor by which the summed rise of all absorbers can exceed ε P R.

    It covers the declared uncertainty and the higher resistance of hot bridges. The absorbers' heat stays below ε P ×
    the largest R C; dividing it by the smallest C gives the rise.
    """
    uncertainty = config.limits.uncertainty
    capacity_ratio = (1 + uncertainty.absorber_capacity) / (1 - uncertainty.absorber_capacity) * capacity
    return float(
        (1 + uncertainty.absorbed_power)
        * (1 + uncertainty.bridge_resistance)
        * capacity_ratio
        * _compute_bridge_factor(config, terms)
    )


def _compute_bridge_factor(config: Config, terms: Mapping[str, TermValues]) -> float:
    """Return the factor by which the resistance of a hot bridge can exceed that of a cold one."""
    temperature_ratio = (config.limits.absorber_max_c + ZERO_CELSIUS_K) / (config.ambient_c + ZERO_CELSIUS_K)
    exponent = terms.get("bridge_conductivity", {}).get("exponent", 0.0) + config.limits.uncertainty.exponent
    return float(max(1.0, temperature_ratio**exponent))


def build_nominal_model(
    parameters: ParameterSet,
    pixels: PixelArray,
    neighbours: Neighbours,
    ambient_k: float,
    heat_gain: HeatGainBound = NO_HEAT_GAIN,
    panel: NominalPanel | None = None,
) -> NominalThermalModel:
    """Build the limiter's thermal model from a parameter set.

    ambient_k: ambient temperature, K; heat_gain: bound on the terms outside the model; panel: None for one that stays
    at ambient temperature
    """
    terms = {key: parameters.term_values(key) for key in parameters.term_keys}
    wall, lateral, touch = (terms.get(key) for key in ("wall_heating", "lateral_conduction", "touch_surface"))
    walls = None
    if wall is not None:
        walls = NominalWalls(
            r_k_per_w=wall["resistance"],
            c_j_per_k=compute_capacity(wall),
            lateral_k_per_w=lateral["resistance"] if lateral else np.inf,
            frame_k_per_w=lateral["frame_resistance"] if lateral else np.inf,
        )
    return NominalThermalModel(
        epsilon=pixels.epsilon * heat_gain.power_factor,
        r_k_per_w=pixels.r_k_per_w,
        c_j_per_k=pixels.c_j_per_k,
        hot_capacity_factor=heat_gain.capacity_factor,
        delay_factor=heat_gain.delay_factor,
        extra_rise_k=heat_gain.uniform_rise_k,
        tau_g_s=float(pixels.tau_g_s.max()),
        ambient_k=ambient_k,
        exponent=terms.get("bridge_conductivity", {}).get("exponent", 0.0),
        neighbours=neighbours.indices,
        frame_edges=neighbours.frame_edges,
        walls=walls,
        touch=NominalTouch(touch["gas_share"], touch["wall_share"], touch["lag"]) if touch else None,
        panel=panel,
    )
