"""Recordings of a chosen strength: the residual of the best nominal fit, in σ of noise that is known exactly.

    case = draw_case_of_strength("single", 5.0, seed, folder)      # None where no size of the effect has that strength

Sizes are scaled from those that `blind_causes` draws; ageing and lagging lasers have more forms here.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from blind_causes import CATALOGUE, CONFUSABLE, MECHANISMS, Draw, Effect, Rng, SessionScale, apply_effects
from blind_display import DISPLACEMENT, FORCE, TEMPERATURE
from blind_lab import Case, build_session, is_too_hot
from blind_session import draw_base, draw_design, draw_instruments, reduce_power, simulate_ideal_rises, write_recording

TOLERANCE = 0.1
"""Largest relative deviation of a strength from the wanted one."""
MAX_DRAWS, MAX_SCALINGS, MAX_FACTOR = 2, 10, 10.0
"""Effects drawn, sizes tried of each, and the largest multiple of a drawn size."""
PROPORTIONAL = (
    *("bridge_n", "capacity_c", "radiating", "crosstalk", "turn_on_s", "droop", "power_size", "ageing_loss", "stray"),
    *("leak", "creep", "sensor_s", "room_k", "room_in_run", "clock_s", "wall_r", "wall2_r", "mirror_delay_s"),
    *("after_s", "glare", "hop", "play_m", "node_share", "hum", "missed", "melt_j", "one_way", "slack_m"),
    *("jump", "wander"),
)
INVERSE = ("wall_c", "wall2_c", "stiff_m", "mirror_hz", "mirror_slew", "ring_hz")
POWERS = dict.fromkeys(PROPORTIONAL, 1.0) | dict.fromkeys(INVERSE, -1.0)
"""Power of the factor on an effect's size with which its changes of the physics scale; others stay."""


def draw_ageing(rng: Rng, scene: SessionScale) -> Effect:
    """Draw an absorber that ages by dose, over the time, from run to run, or at once."""
    form = str(rng.choice(["linear", "saturating", "by_time", "by_run", "step"]))
    changes: dict[str, object] = {
        "ageing": form,
        "ageing_loss": 0.1,
        "ageing_dose": scene.dose_j,
        "ageing_knee": float(rng.uniform(0.2, 0.6)),
        "ageing_s": scene.session_s * (float(rng.uniform(0.25, 0.75)) if form == "step" else 1.0),
        "ageing_runs": 25.0,
    }
    return Effect("absorber_ageing", form, {}, changes)


def draw_laser_lag(rng: Rng, scene: SessionScale) -> Effect:
    """Draw a laser that follows its command exponentially, at both edges."""
    tau = float(np.exp(rng.uniform(np.log(1e-4), np.log(2e-3))))
    changes: dict[str, object] = {"turn_on": "exponential", "turn_on_s": tau, "after": "fading", "after_s": tau}
    return Effect("laser_lag", "both_edges", {}, changes)


def draw_line(rng: Rng, scene: SessionScale) -> Effect:
    """Draw a line of one instrument, of one phase in all runs or of another in each."""
    signal, hz = str(rng.choice(scene.signals)), float(np.exp(rng.uniform(np.log(15.0), np.log(300.0))))
    is_random = bool(rng.random() < 0.7)
    changes: dict[str, object] = {
        "hum_signal": signal,
        "hum": ZEROS[signal],
        "hum_hz": hz,
        "hum_is_random": is_random,
        "hum_phase": float(rng.uniform(0.0, 6.0)),
    }
    return Effect("line", "random_phase" if is_random else "one_phase", {"hz": hz}, changes)


def draw_jumps(rng: Rng, scene: SessionScale) -> Effect:
    """Draw hops of one instrument's zero."""
    signal = str(rng.choice(scene.signals))
    changes: dict[str, object] = {
        "jump_signal": signal,
        "jump": ZEROS[signal] * float(rng.uniform(2.0, 4.0)),
        "jump_rate": float(np.exp(rng.uniform(np.log(0.5), np.log(4.0)))),
    }
    return Effect("hops", "telegraph", {}, changes)


def draw_drift(rng: Rng, scene: SessionScale) -> Effect:
    """Draw a drift of the zero of the displacement or of the force over the session."""
    signal, form = str(rng.choice(scene.signals[1:])), str(rng.choice(["ramp", "sine"]))
    changes: dict[str, object] = {
        "wander_signal": signal,
        "wander": ZEROS[signal],
        "wander_s": scene.session_s * (float(rng.uniform(0.8, 2.0)) if form == "sine" else 1.0),
        "wander_phase": float(rng.uniform(0.1, 6.2)) if form == "sine" else 0.0,
    }
    return Effect("drift", form, {}, changes)


ZEROS = {TEMPERATURE: 0.8, DISPLACEMENT: 5e-6, FORCE: 1.5e-3}
"""Usual sizes of disturbances, some samples' noise."""
INSTRUMENTS: dict[str, Draw] = {"line": draw_line, "hops": draw_jumps, "drift": draw_drift}
CAUSES: dict[str, Draw] = {key: draw for key, draw in CATALOGUE.items() if key != "sensor_scale"}
CAUSES |= {"absorber_ageing": draw_ageing, "laser_lag": draw_laser_lag}


def scale_effect(effect: Effect, factor: float) -> Effect:
    """Return the effect at another size."""
    changes = dict(effect.changes)
    for name, value in changes.items():
        scale = factor ** POWERS.get(name, 0.0)
        if name not in POWERS:
            continue
        if isinstance(value, tuple):
            changes[name] = tuple(scale * item for item in value)
        elif isinstance(value, dict):
            changes[name] = {key: scale * item for key, item in value.items()}
        elif isinstance(value, float):
            changes[name] = scale * value
    return replace(effect, changes=changes)


def draw_keys(kind: str, rng: Rng) -> tuple[str, ...]:
    """Return the keys of the effects to hide: of no, one or two causes, of another mechanism, or of an instrument."""
    keys = list(CAUSES)
    if kind == "pair":
        pairs = [(a, b) for a in keys for b in keys if a < b and frozenset((a, b)) not in CONFUSABLE]
        return pairs[int(rng.integers(len(pairs)))]
    if kind == "unknown":
        return (str(rng.choice(list(MECHANISMS))),)
    if kind == "instrument":
        return (str(rng.choice(list(INSTRUMENTS))),)
    return (str(rng.choice(keys)),) if kind == "single" else ()


def draw_case_of_strength(
    kind: str, strength: float, seed: int, folder: str | Path, chosen: tuple[str, ...] | None = None, form: str = ""
) -> Case | None:
    """Draw a hidden display and a recording of it, and return it with the ground truth.

    kind: "none", "single", "pair", "unknown" or "instrument"; chosen: keys of the effects, drawn by default;
    form: of all of them, drawn by default
    """
    rng = np.random.default_rng([seed, 31])
    keys = draw_keys(kind, rng) if chosen is None else chosen
    base, width = draw_base(rng)
    instruments = draw_instruments(rng)
    pixels = "beam_misalignment" in keys or bool(rng.random() < 0.2)
    mirrors = "mirror_lag" in keys or bool(rng.random() < 0.25)
    design = draw_design(rng, base, instruments, pixels=pixels, mirrors=mirrors)
    session = build_session(base, instruments, design, [seed, 32])
    while is_too_hot(session, base):
        session = build_session(base, instruments, reduce_power(session.design, 0.88), [seed, 32])
    found = None if keys else ((), base, 0.0)
    for _ in range(MAX_DRAWS if keys else 0):
        effects = tuple(_draw_effect(key, form, rng, session.scene) for key in keys)
        if len(effects) > 1:  # each alone first, so that neither hides behind the other
            alone = [_scale_to_strength(session, (effect,), strength) for effect in effects]
            effects = tuple(item[0][0] for item in alone if item is not None)
        found = _scale_to_strength(session, effects, strength) if len(effects) == len(keys) else None
        if found is not None:
            break
    if found is None:
        return None
    effects, truth, sigma = found
    path = Path(folder) / "case.h5"
    noise = np.random.default_rng([seed, 33])
    stated_width = width if rng.random() < 0.5 else None
    write_recording(path, session.runs, truth, session.instruments, noise, stated_width)
    known = {name: getattr(base, name) for name in ("R", "C", "tau_g", "kappa", "phi")}
    causes = (kind, *keys) if kind in ("unknown", "instrument") else keys
    return Case(path, kind, seed, causes, {}, known, sigma, effects, truth, session.runs, session.instruments)


def _draw_effect(key: str, form: str, rng: Rng, scene: SessionScale) -> Effect:
    while True:
        effect = (CAUSES | MECHANISMS | INSTRUMENTS)[key](rng, scene)
        if form in ("", effect.form):
            return effect


def _scale_to_strength(session, effects: tuple[Effect, ...], strength: float):
    """Return the effects at a size of that strength, the physics with them and the strength, None if there is none."""
    factor, low, high = 1.0, (0.0, 0.0), (np.inf, np.inf)  # factors and strengths below and above the wanted one
    for _ in range(MAX_SCALINGS):
        scaled = tuple(scale_effect(effect, factor) for effect in effects)
        truth = apply_effects(session.base, scaled)
        sigma = np.inf
        if not is_too_hot(session, truth):
            sigma = session.bench.sigma(simulate_ideal_rises(session.base, session.runs, truth))
        if abs(sigma / strength - 1.0) < TOLERANCE:
            return scaled, truth, sigma
        low, high = ((factor, sigma), high) if sigma < strength else (low, (factor, sigma))
        if factor == MAX_FACTOR and sigma < strength:
            return None
        factor = min(_guess_factor(low, high, strength), MAX_FACTOR)
    return None


def _guess_factor(low: tuple[float, float], high: tuple[float, float], strength: float) -> float:
    """Return a factor between those of a smaller and of a larger strength: by a power law, else their mean."""
    (small, weak), (large, strong) = low, high
    if np.isinf(large):
        return small * float(np.clip(strength / max(weak, 1e-3), 1.2, 20.0))
    if small <= 0.0:
        return large * (0.5 if np.isinf(strong) else float(np.clip(strength / strong, 0.02, 0.8)))
    if weak <= 0.0 or np.isinf(strong):
        return float(np.sqrt(small * large))
    share = np.log(strength / weak) / np.log(strong / weak)
    return float(small * (large / small) ** np.clip(share, 0.1, 0.9))
