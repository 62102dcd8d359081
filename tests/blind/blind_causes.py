"""Hidden effects of a blind recording: the catalogue's causes, and mechanisms outside the catalogue.

A cause is drawn as an `Effect`: its key, functional form, sizes and changes to the physics. `textbook` is True only if
the form is that of the catalogue.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from blind_display import CREEP_TERMS, DISPLACEMENT, FORCE, TEMPERATURE, Physics

Rng = np.random.Generator


@dataclass(frozen=True)
class Effect:
    """One hidden effect."""

    key: str
    form: str
    sizes: dict[str, float]
    changes: dict[str, object] = field(default_factory=dict)
    textbook: bool = False


@dataclass(frozen=True)
class SessionScale:
    """Scales of the experiment that the sizes of an effect depend on."""

    base: Physics
    signals: tuple[str, ...]
    peak_gas_k: float  # nominal gas rise at the largest pulse
    peak_k: float  # nominal absorber rise there
    dose_j: float  # light on pixel 0 over the session
    session_s: float
    pixels: tuple[int, ...]


def _log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _pick(rng: Rng, *forms: str) -> str:
    return str(rng.choice(list(forms)))


def _bridge_conductivity(rng: Rng, scene: SessionScale) -> Effect:
    n, form = float(rng.uniform(0.04, 1.3)), _pick(rng, "mean", "integrated")
    return Effect("bridge_conductivity", form, {"n": n}, {"bridge": form, "bridge_n": n}, form == "mean")


def _heat_capacity(rng: Rng, scene: SessionScale) -> Effect:
    c, form = float(rng.uniform(0.01, 0.4)), _pick(rng, "linear", "graphite")
    changes: dict[str, object] = {"capacity": form, "capacity_c": c, "capacity_knee": float(rng.uniform(200.0, 450.0))}
    return Effect("heat_capacity", form, {"c": c}, changes, form == "linear")


def _radiation(rng: Rng, scene: SessionScale) -> Effect:
    area, form = _log(rng, 1e-6, 1e-5), _pick(rng, "grey", "rising_emissivity")
    rise = 0.0 if form == "grey" else float(rng.uniform(0.1, 0.5))
    changes: dict[str, object] = {"radiating": area, "radiating_rise": rise}
    return Effect("radiation", form, {"eps_A": area}, changes, form == "grey")


def _wall_heating(rng: Rng, scene: SessionScale) -> Effect:
    r, tau, form = _log(rng, 1.0, 40.0), _log(rng, 0.1, 10.0), _pick(rng, "one_node", "two_nodes")
    changes: dict[str, object] = {"wall_r": r, "wall_c": tau / r}
    if form == "two_nodes":
        r2 = r * float(rng.uniform(0.15, 0.4))
        changes |= {"wall2_r": r2, "wall2_c": tau * float(rng.uniform(3.0, 8.0)) / r2}
    return Effect("wall_heating", form, {"R_w": r, "tau_w": tau}, changes, form == "one_node")


def _neighbour_crosstalk(rng: Rng, scene: SessionScale) -> Effect:
    share, form = _log(rng, 0.002, 0.1), _pick(rng, "instant", "lagged")
    lag = 0.0 if form == "instant" else _log(rng, 0.02, 0.2)
    changes: dict[str, object] = {"crosstalk": share, "crosstalk_lag": lag}
    return Effect("neighbour_crosstalk", form, {"kappa_x": share}, changes, form == "instant")


def _laser_turn_on(rng: Rng, scene: SessionScale) -> Effect:
    tau, form = _log(rng, 2e-5, 3e-3), _pick(rng, "ramp", "exponential", "raised_cosine")
    changes: dict[str, object] = {"turn_on": form, "turn_on_s": tau}
    return Effect("laser_turn_on", form, {"tau": tau}, changes, form == "exponential")


def _laser_droop(rng: Rng, scene: SessionScale) -> Effect:
    depth, tau, form = _log(rng, 0.01, 0.2), _log(rng, 3e-3, 1.0), _pick(rng, "one_exponential", "two_exponentials")
    by_power = bool(rng.random() < 0.5)
    share = 1.0 if form == "one_exponential" else float(rng.uniform(0.4, 0.7))
    slow = tau * float(rng.uniform(4.0, 12.0))
    changes: dict[str, object] = {
        "droop": (depth * share, depth * (1.0 - share)),
        "droop_s": (tau, slow),
        "droop_by_power": by_power,
    }
    textbook = share == 1.0 and by_power  # the term's share is that of the full power, and follows it
    return Effect("laser_droop", form, {"depth": depth, "tau": tau}, changes, textbook)


def _power_nonlinearity(rng: Rng, scene: SessionScale) -> Effect:
    form = _pick(rng, "threshold", "threshold_full", "curvature")
    size = _sign(rng) * float(rng.uniform(0.01, 0.2)) if form == "curvature" else _log(rng, 0.01, 0.4)
    name = "curvature" if form == "curvature" else "threshold_W"
    return Effect("power_nonlinearity", form, {name: size}, {"power": form, "power_size": size})


def _sensor_lag(rng: Rng, scene: SessionScale) -> Effect:
    tau, form = _log(rng, 5e-5, 3e-3), _pick(rng, "first_order", "moving_average")
    return Effect("sensor_lag", form, {"tau": tau}, {"sensor": form, "sensor_s": tau}, form == "first_order")


def _sensor_scale(rng: Rng, scene: SessionScale) -> Effect:
    gain = 1.0 + _sign(rng) * float(rng.uniform(0.02, 0.1))
    return Effect("sensor_scale", "affine", {"gain": gain}, {"scale": gain}, True)


def _membrane_creep(rng: Rng, scene: SessionScale) -> Effect:
    size, tau = _log(rng, 0.03, 0.5), _log(rng, 0.01, 1.0)
    form = _pick(rng, "exponential", "power_law", "logarithmic")
    if form == "exponential":
        weights, times = np.array([size]), np.array([tau])
    elif form == "power_law":
        times = np.geomspace(0.1 * tau, 30.0 * tau, CREEP_TERMS)
        weights = times ** float(rng.uniform(0.15, 0.4))
    else:
        times = np.geomspace(0.5 * tau, 50.0 * tau, CREEP_TERMS)
        weights = np.ones(CREEP_TERMS)
    if form != "exponential":
        reached = float(np.sum(weights * -np.expm1(-3.0 * tau / times)))
        weights = weights * size / reached
    changes: dict[str, object] = {"creep": tuple(weights.tolist()), "creep_s": tuple(times.tolist())}
    return Effect("membrane_creep", form, {"J": size, "tau": tau}, changes, form == "exponential")


def _membrane_stiffening(rng: Rng, scene: SessionScale) -> Effect:
    loss, form = _log(rng, 0.02, 0.35), _pick(rng, "cubic", "tanh")
    peak = scene.base.kappa * scene.peak_gas_k
    z = (1.0 - loss) * peak
    if form == "cubic":
        scale = float(np.sqrt(z**3 / (peak - z)))
    else:
        low, high = 0.3 * peak, 100.0 * peak
        for _ in range(200):
            scale = float(np.sqrt(low * high))
            low, high = (scale, high) if scale * np.tanh(peak / scale) < z else (low, scale)
    return Effect("membrane_stiffening", form, {"loss_at_peak": loss}, {"stiff": form, "stiff_m": scale})


def _gas_leak(rng: Rng, scene: SessionScale) -> Effect:
    rate = _log(rng, 0.1, 10.0)
    return Effect("gas_leak", "exponential", {"rate": rate}, {"leak": rate}, True)


def _absorber_ageing(rng: Rng, scene: SessionScale) -> Effect:
    loss, form = _log(rng, 0.01, 0.2), _pick(rng, "linear", "saturating")
    knee = float(rng.uniform(0.2, 0.6))
    changes: dict[str, object] = {
        "ageing": form,
        "ageing_loss": loss,
        "ageing_dose": scene.dose_j,
        "ageing_knee": knee,
    }
    return Effect("absorber_ageing", form, {"loss": loss, "dose_j": scene.dose_j}, changes, form == "linear")


def _beam_misalignment(rng: Rng, scene: SessionScale) -> Effect:
    share, pixel = _log(rng, 0.02, 0.3), int(rng.choice(scene.pixels))
    r, tau = float(rng.uniform(1.0, 6.0)), _log(rng, 0.1, 2.0)
    changes: dict[str, object] = {
        "stray_pixel": pixel,
        "stray": share,
        "wall_r": r,
        "wall_c": tau / r,
        "wall_takes_flow": 0.0,
    }
    return Effect("beam_misalignment", "into_the_wall", {"f": share, "pixel": pixel}, changes)


def _ambient_drift(rng: Rng, scene: SessionScale) -> Effect:
    size, form = _sign(rng) * _log(rng, 0.3, 5.0), _pick(rng, "ramp", "sine")
    changes: dict[str, object] = {
        "room": form,
        "room_k": size,
        "room_phase": float(rng.uniform(0.0, 2 * np.pi)),
        "room_session_s": scene.session_s * (1.0 if form == "ramp" else float(rng.uniform(0.6, 2.0))),
        "room_in_run": size * float(rng.uniform(0.0, 0.03)),
    }
    return Effect("ambient_drift", form, {"K": size}, changes)


def _clock_offset(rng: Rng, scene: SessionScale) -> Effect:
    size = _sign(rng) * _log(rng, 5e-5, 3e-3)
    every = ("mirror_x_rad", "mirror_y_rad", *scene.signals)
    form = _pick(rng, "all", *scene.signals)
    which = every if form == "all" else (form,)
    return Effect("clock_offset", form, {"offset": size}, {"clock_s": dict.fromkeys(which, size)}, True)


def _mirror_lag(rng: Rng, scene: SessionScale) -> Effect:
    hz, zeta = _log(rng, 300.0, 3000.0), float(rng.uniform(0.3, 1.0))
    form = _pick(rng, "servo", "servo_delay", "servo_slew", "servo_delay_slew")
    delay = _log(rng, 3e-5, 4e-4) if "delay" in form else 0.0
    slew = _log(rng, 20.0, 200.0) if "slew" in form else 0.0
    changes: dict[str, object] = {
        "mirror_hz": hz,
        "mirror_zeta": zeta,
        "mirror_delay_s": delay,
        "mirror_slew": slew,
    }
    sizes = {"hz": hz, "zeta": zeta, "delay": delay, "slew": slew}
    return Effect("mirror_lag", form, sizes, changes, form == "servo")


Draw = Callable[[Rng, SessionScale], Effect]

CATALOGUE: dict[str, Draw] = {
    "bridge_conductivity": _bridge_conductivity,
    "heat_capacity": _heat_capacity,
    "radiation": _radiation,
    "wall_heating": _wall_heating,
    "neighbour_crosstalk": _neighbour_crosstalk,
    "laser_turn_on": _laser_turn_on,
    "laser_droop": _laser_droop,
    "power_nonlinearity": _power_nonlinearity,
    "sensor_lag": _sensor_lag,
    "sensor_scale": _sensor_scale,
    "membrane_creep": _membrane_creep,
    "membrane_stiffening": _membrane_stiffening,
    "gas_leak": _gas_leak,
    "absorber_ageing": _absorber_ageing,
    "beam_misalignment": _beam_misalignment,
    "ambient_drift": _ambient_drift,
    "clock_offset": _clock_offset,
    "mirror_lag": _mirror_lag,
}

# Pairs of causes that the catalogue lists as easily confused; a hidden pair is never one of these.
CONFUSABLE: frozenset[frozenset[str]] = frozenset(
    frozenset(pair)
    for pair in (
        ("bridge_conductivity", "radiation"),
        ("bridge_conductivity", "heat_capacity"),
        ("bridge_conductivity", "laser_droop"),
        ("radiation", "power_nonlinearity"),
        ("wall_heating", "membrane_creep"),
        ("wall_heating", "gas_leak"),
        ("wall_heating", "neighbour_crosstalk"),
        ("wall_heating", "beam_misalignment"),
        ("laser_turn_on", "clock_offset"),
        ("laser_turn_on", "sensor_lag"),
        ("laser_turn_on", "mirror_lag"),
        ("power_nonlinearity", "absorber_ageing"),
        ("power_nonlinearity", "membrane_stiffening"),
        ("sensor_lag", "clock_offset"),
        ("membrane_creep", "gas_leak"),
        ("absorber_ageing", "ambient_drift"),
        ("absorber_ageing", "beam_misalignment"),
        ("sensor_scale", "ambient_drift"),
    )
)


def _membrane_resonance(rng: Rng, scene: SessionScale) -> Effect:
    hz, zeta = _log(rng, 80.0, 400.0), _log(rng, 0.03, 0.2)
    return Effect("membrane_resonance", "z only", {"hz": hz, "zeta": zeta}, {"ring_hz": hz, "ring_zeta": zeta})


def _glare(rng: Rng, scene: SessionScale) -> Effect:
    """Stray light of the beam shifts the displacement meter during pulses.

    (A share of the absorber's temperature in z was tried as well: with refitted τ_g and κ a clock offset imitates it.)
    """
    size = scene.base.kappa * scene.peak_gas_k * float(rng.uniform(0.01, 0.06)) / 2.45
    return Effect("glare", "step", {"m_per_W": size}, {"glare": size})


def _mode_hops(rng: Rng, scene: SessionScale) -> Effect:
    size, rate = float(rng.uniform(0.03, 0.08)), _log(rng, 10.0, 60.0)
    return Effect("mode_hops", "telegraph", {"share": size, "rate": rate}, {"hop": size, "hop_rate": rate})


def _membrane_play(rng: Rng, scene: SessionScale) -> Effect:
    reach = scene.base.kappa * scene.peak_gas_k * float(rng.uniform(0.02, 0.08))
    return Effect("membrane_play", "dead travel", {"dead_travel_m": reach}, {"play_m": reach})


def _thermometer_ceiling(rng: Rng, scene: SessionScale) -> Effect:
    at, slope = 295.0 + scene.peak_k * float(rng.uniform(0.35, 0.75)), float(rng.choice([0.0, 0.2, 0.4]))
    return Effect("thermometer_ceiling", "clip", {"at_K": at}, {"ceiling_k": at, "ceiling_slope": slope})


def _second_node(rng: Rng, scene: SessionScale) -> Effect:
    share, tau = float(rng.uniform(0.15, 0.5)), _log(rng, 0.01, 0.06)
    return Effect("second_node", "behind", {"share": share, "tau": tau}, {"node_share": share, "node_s": tau})


def _hum(rng: Rng, scene: SessionScale) -> Effect:
    signal = str(rng.choice([TEMPERATURE, DISPLACEMENT] + [FORCE] * (FORCE in scene.signals)))
    size = {TEMPERATURE: 0.8, DISPLACEMENT: 4e-6, FORCE: 1.5e-3}[signal] * _log(rng, 1.0, 4.0)
    changes: dict[str, object] = {"hum_signal": signal, "hum": size, "hum_phase": float(rng.uniform(0, 2 * np.pi))}
    return Effect("hum", signal, {"amplitude": size}, changes)


def _late_light(rng: Rng, scene: SessionScale) -> Effect:
    tau, form = _log(rng, 1e-3, 5e-3), _pick(rng, "flat", "fading")
    share = float(rng.uniform(0.3, 1.0))
    changes: dict[str, object] = {"after": form, "after_s": tau, "after_share": share}
    return Effect("late_light", form, {"tau": tau, "share": share}, changes)


def _missed_pulses(rng: Rng, scene: SessionScale) -> Effect:
    share = float(rng.uniform(0.03, 0.12))
    return Effect("missed_pulses", "random", {"share": share}, {"missed": share})


def _melting(rng: Rng, scene: SessionScale) -> Effect:
    """A substance on the absorber melts: latent heat at one temperature."""
    at = scene.peak_k * float(rng.uniform(0.3, 0.6))
    heat = scene.base.C * scene.peak_k * float(rng.uniform(0.05, 0.25))
    changes: dict[str, object] = {"melt_j": heat, "melt_at": at, "melt_width": float(rng.uniform(4.0, 10.0))}
    return Effect("melting", "latent heat", {"J": heat, "at_K": at}, changes)


def _one_way_gas(rng: Rng, scene: SessionScale) -> Effect:
    """The gas cools more slowly than it warms, or faster."""
    size = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.25, 0.5))
    return Effect("one_way_gas", "rate", {"share": size}, {"one_way": size})


def _slack_membrane(rng: Rng, scene: SessionScale) -> Effect:
    size = scene.base.kappa * scene.peak_gas_k * float(rng.uniform(0.03, 0.12))
    return Effect("slack_membrane", "dead zone", {"m": size}, {"slack_m": size})


MECHANISMS: dict[str, Draw] = {
    "membrane_resonance": _membrane_resonance,
    "glare": _glare,
    "mode_hops": _mode_hops,
    "membrane_play": _membrane_play,
    "thermometer_ceiling": _thermometer_ceiling,
    "second_node": _second_node,
    "hum": _hum,
    "late_light": _late_light,
    "missed_pulses": _missed_pulses,
    "melting": _melting,
    "one_way_gas": _one_way_gas,
    "slack_membrane": _slack_membrane,
}


def apply_effects(base: Physics, effects: tuple[Effect, ...]) -> Physics:
    """Return the physics of the display with all effects."""
    truth = base
    for effect in effects:
        changes = dict(effect.changes)
        if "wall_takes_flow" in changes and truth.wall_r:  # both use the one wall
            changes = {k: v for k, v in changes.items() if not k.startswith("wall")}
        truth = truth.with_(**changes)
    return truth
