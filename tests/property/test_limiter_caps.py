"""No sequence exceeds a cap, verified by an integrator that shares no code with the limiter."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from optodrive.core.errors import InputError
from optodrive.planning.limiter.budget import Budget, GalvoModel, GalvoModels
from optodrive.planning.limiter.limiter import build_cold_budget_state, commit_until, limit, shift_state
from optodrive.planning.limiter.worst_case import build_heat_bound
from reference_models.thermal_display import (
    KINDS,
    NO_CAPS,
    TOUCHED,
    build_lasers,
    build_long_sequence,
    build_plan,
    build_sequence,
    build_stages,
    build_true_display,
    galvo_peak,
    random_model,
    sample_factors,
    upper_factors,
    window_peak_w,
)

FULL_W = 2.45
LONG = "long"
"""Kind of sequence that lasts several time constants of the panel, up to hours."""


def random_caps(rng):
    """Sample heat caps that bind within seconds. The other caps bind occasionally."""
    return NO_CAPS._replace(
        absorber_k=rng.uniform(60.0, 380.0),
        wall_k=rng.choice([rng.uniform(1.0, 15.0), 60.0]),
        touch_k=rng.choice([rng.uniform(1.0, 20.0), 60.0]),
        galvo_rad2_per_s4=rng.choice([inf, 10 ** rng.uniform(3.5, 5.5)]) ** 2,
        pixel_mean_w=rng.choice([1e3, 1.3]),
        display_mean_w=rng.choice([1e3, rng.uniform(0.2, 2.0)]),
    )


def random_mirrors(rng):
    """Sample underdamped and slow servos. Every ramp ends while the gate of `build_sequence` is off."""
    return GalvoModel(
        omega_rad_per_s=2 * np.pi * 10 ** rng.uniform(2.3, 3.6),
        damping=rng.uniform(0.3, 0.9),
        delay_s=rng.uniform(0.0, 1e-4),
        slew_rad_per_s=10 ** rng.uniform(2.0, 2.5),
        lead_in_s=rng.uniform(5e-4, 3e-3),
        averaging_s=rng.choice([0.1, 1.0, 3.0]),
        rad_per_code=0.0,
        timing_slack_s=0.0,
        early_s=0.0,
    )


def build_budget(model, unsure, caps, mirrors, skew_s=0.0):
    """Return the budget of as many stages as there are mirrors."""
    heat = build_heat_bound(model, unsure, caps, *[FULL_W] * len(mirrors), skew_s=skew_s)
    return Budget(caps, heat, GalvoModels.from_models(*mirrors), *build_lasers(1e-6, len(mirrors)))


def limit_in_batches(rng, plan, budget, pixels):
    """Limit the plan batch by batch. Some batches are cancelled half-way, and their executed pulses are committed."""
    state, committed, at = build_cold_budget_state(pixels, stage_count=len(budget.galvos.damping)), [], 0
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


def select_rows(plan, rows):
    """Return some of a plan's pulses."""
    return type(plan)(**{name: column[rows] for name, column in vars(plan).items()})


def skew_clocks(rng, plan, skew_s, stages):
    """Return a plan whose stages have clocks that differ by up to skew_s."""
    offset_s = rng.uniform(0.0, skew_s, stages)[plan.stage]
    late = replace(plan, start_s=plan.start_s + offset_s)
    return select_rows(late, np.argsort(late.start_s, kind="stable"))


def cap_fractions(kind, seed, mutate=lambda budget: budget):
    """Return the largest value over each cap for a random sequence on a display sampled within the uncertainty."""
    rng = np.random.default_rng(seed)
    display, model, unsure = random_model(rng)
    caps = random_caps(rng)
    pixels, stages = len(model.epsilon), int(rng.choice([1, 1, 2, 3, 4]))
    skew_s = 0.0 if stages == 1 else rng.choice([0.0, 1e-4, 5e-4])
    if kind == LONG:
        panel_s = 60.0 if model.panel is None else model.panel.r_k_per_w * model.panel.c_j_per_k
        rows, stage = build_stages(rng, stages, pixels, lambda own: build_long_sequence(rng, own, panel_s))
    else:
        span_s = rng.uniform(0.5, 4.0)
        rows, stage = build_stages(rng, stages, pixels, lambda own: build_sequence(rng, kind, own, span_s))
    requested = build_plan(rows, FULL_W * rng.uniform(0.3, 1.0, len(rows)) ** rng.choice([0.0, 1.0]), display, stage)
    budget = build_budget(model, unsure, caps, [random_mirrors(rng) for _ in range(stages)], skew_s)
    limited = limit_in_batches(rng, requested, mutate(budget), pixels)
    if not len(limited):
        return {}
    plan, beams = skew_clocks(rng, limited, skew_s, stages), range(stages)
    real = build_true_display(model, upper_factors(unsure) if rng.random() < 0.3 else sample_factors(rng, unsure))
    peaks = real.peaks(plan)
    return {
        "absorber": peaks[0] / caps.absorber_k,
        "wall": peaks[2] / caps.wall_k if model.walls is not None else 0.0,
        "touched": max(peaks[row] for row in TOUCHED) / caps.touch_k,
        "galvo": max(galvo_peak(plan, budget, stage) for stage in beams) / caps.galvo_rad2_per_s4,
        "diode": max(window_peak_w(select_rows(plan, plan.stage == stage), caps.display_window_s) for stage in beams)
        / caps.display_mean_w,
        "pixel": max(
            window_peak_w(select_rows(plan, plan.pixel == pixel), caps.pixel_window_s)
            for pixel in set(plan.pixel.tolist())
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


@settings(max_examples=3 * settings.default.max_examples // 5, deadline=None)
@given(kind=st.sampled_from((*KINDS, LONG)), seed=st.integers(0, 2**40))
def test_no_sequence_exceeds_a_cap(kind, seed):
    check_caps(cap_fractions, kind, seed)


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.parametrize("kind", [*KINDS, LONG])
@settings(max_examples=2_000, deadline=None)
@given(seed=st.integers(0, 2**40))
def test_none_of_twelve_thousand_sequences_exceeds_a_cap(kind, seed):
    check_caps(cap_fractions, kind, seed)
