"""No sequence exceeds a cap, verified by an integrator that shares no code with the limiter."""

from math import inf

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from optodrive.core.errors import InputError
from optodrive.planning.limiter.budget import Budget, GalvoModel
from optodrive.planning.limiter.limiter import build_cold_budget_state, commit_until, limit, shift_state
from optodrive.planning.limiter.worst_case import build_heat_bound
from reference_models.thermal_display import (
    KINDS,
    NO_CAPS,
    build_plan,
    build_sequence,
    build_true_display,
    galvo_peak,
    random_model,
    sample_factors,
    upper_factors,
    window_peak_w,
)

FULL_W = 2.45


def random_caps(rng):
    """Sample heat caps that bind within seconds; the other caps bind occasionally."""
    return NO_CAPS._replace(
        absorber_k=rng.uniform(60.0, 380.0),
        wall_k=rng.choice([rng.uniform(1.0, 15.0), 60.0]),
        touch_k=rng.choice([rng.uniform(1.0, 20.0), 60.0]),
        galvo_rad2_per_s4=rng.choice([inf, 10 ** rng.uniform(3.5, 5.5)]) ** 2,
        pixel_mean_w=rng.choice([1e3, 1.3]),
        display_mean_w=rng.choice([1e3, rng.uniform(0.2, 2.0)]),
    )


def random_mirrors(rng):
    """Sample underdamped and slow servos; every ramp ends while the gate of `build_sequence` is off."""
    return GalvoModel(
        omega_rad_per_s=2 * np.pi * 10 ** rng.uniform(2.3, 3.6),
        damping=rng.uniform(0.3, 0.9),
        delay_s=rng.uniform(0.0, 1e-4),
        slew_rad_per_s=10 ** rng.uniform(2.0, 2.5),
        lead_in_s=rng.uniform(5e-4, 3e-3),
        averaging_s=rng.choice([0.1, 1.0, 3.0]),
        rad_per_code=0.0,
        timing_slack_s=0.0,
    )


def build_budget(model, unsure, caps, mirrors):
    return Budget(caps, build_heat_bound(model, unsure, caps, FULL_W), mirrors)


def limit_in_batches(rng, plan, budget, pixels):
    """Limit the plan batch by batch; some batches are cancelled half-way, and their executed pulses are committed."""
    state, committed, at = build_cold_budget_state(pixels), [], 0
    while at < len(plan):
        until = at + int(rng.integers(1, 120))
        rows = slice(at, until)
        batch = type(plan)(**{name: value[rows] for name, value in vars(plan).items()})
        batch, after = limit(batch, state, budget)
        if rng.random() < 0.2:
            stop_s = float(rng.choice(batch.start_s))
            committed.append((batch, batch.start_s < stop_s))
            state = commit_until(batch, stop_s, state, budget)
        else:
            committed.append((batch, np.full(len(batch), True)))
            state = after
        state = shift_state(shift_state(state, 7.0), -7.0)
        at = until
    columns = {
        name: np.concatenate([vars(batch)[name][executed_rows] for batch, executed_rows in committed])
        for name in vars(plan)
    }
    return type(plan)(**columns)


def select_pixel(plan, pixel):
    """Return a plan's pulses on one pixel."""
    rows = plan.pixel == pixel
    return type(plan)(**{name: column[rows] for name, column in vars(plan).items()})


def cap_fractions(kind, seed):
    """Return the largest value over each cap for a random sequence on a display sampled within the uncertainty."""
    rng = np.random.default_rng(seed)
    display, model, unsure = random_model(rng)
    caps = random_caps(rng)
    rows = build_sequence(rng, kind, len(model.epsilon), rng.uniform(0.5, 4.0))
    requested = build_plan(rows, FULL_W * rng.uniform(0.3, 1.0, len(rows)) ** rng.choice([0.0, 1.0]), display)
    budget = build_budget(model, unsure, caps, random_mirrors(rng))
    plan = limit_in_batches(rng, requested, budget, len(model.epsilon))
    if not len(plan):
        return {}
    real = build_true_display(model, upper_factors(unsure) if rng.random() < 0.3 else sample_factors(rng, unsure))
    absorber, _, wall, touch = real.peaks(plan)
    return {
        "absorber": absorber / caps.absorber_k,
        "wall": wall / caps.wall_k,
        "touch": touch / caps.touch_k,
        "galvo": galvo_peak(plan, budget) / caps.galvo_rad2_per_s4,
        "diode": window_peak_w(plan, caps.display_window_s) / caps.display_mean_w,
        "pixel": max(
            window_peak_w(select_pixel(plan, pixel), caps.pixel_window_s) for pixel in set(plan.pixel.tolist())
        )
        / caps.pixel_mean_w,
    }


def check_caps(compute_fractions, kind, seed):
    """Assert that the fractions of the caps that a random sequence reaches do not exceed 1."""
    try:
        fractions = compute_fractions(kind, seed)
    except InputError:  # a wall too fast for a bound, which the configuration refuses
        reject()
    for name, fraction in fractions.items():
        assert fraction <= 1 + 1e-6, f"{name} cap exceeded: {fraction}"


@settings(max_examples=2 * settings.default.max_examples, deadline=None)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 2**40))
def test_no_sequence_exceeds_a_cap(kind, seed):
    check_caps(cap_fractions, kind, seed)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@settings(max_examples=12_000, deadline=None)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 2**40))
def test_none_of_twelve_thousand_sequences_exceeds_a_cap(kind, seed):
    check_caps(cap_fractions, kind, seed)
