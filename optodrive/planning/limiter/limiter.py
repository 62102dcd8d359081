"""Limit the pulses of a plan by the caps, given the budget state after earlier plans.

The caps define a set of absorber, wall and touch temperatures that is invariant while the gate is off: no wall is
allowed above the temperature at which the touch surface would reach its cap in steady state. It is therefore sufficient
to check each pulse up to its end; accepted pulses cannot exceed a cap at any later time.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from math import inf
from typing import NamedTuple, Protocol

import numpy as np

from optodrive.core.errors import LocalProtocolError, OverBudgetError, RefusedError
from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import EMPTY_PLAN, BudgetState, LimitedPlan, PulsePlan
from optodrive.core.types.push_options import Policy
from optodrive.planning.limiter.budget import TOLERANCE, Budget
from optodrive.planning.limiter.caps import CAPS_BY_KEY, REASONS, WRONG_ORDER
from optodrive.planning.limiter.galvo_load import count_galvo_feasible
from optodrive.planning.limiter.pulse_application import (
    COLD_START,
    COUNT_ONLY,
    STOP,
    TRIM,
    apply_pulses,
)
from optodrive.planning.limiter.workspace import LimiterWorkspace, PixelBudgets, close_workspace, open_workspace

# A compiled loop answers nobody: progress keeps the planner's beat, and without it link withholds the lease.
CHUNK_PULSES = 20_000
"""Pulses between two progress reports, about a tenth of a second."""


def _ignore_progress() -> None:
    """Do nothing."""


class _EncodedPulses(NamedTuple):
    """Encoded pulses, together with the omitted pulses at zero power, all arrays [n]."""

    start_s: FloatArray
    width_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray
    power_w: FloatArray


class TimedPulses(Protocol):
    """Pulses in order of their starts, all arrays [n]."""

    @property
    def start_s(self) -> FloatArray:
        """Gate-on time, s."""

    @property
    def width_s(self) -> FloatArray:
        """Gate-on duration, s."""

    @property
    def x_rad(self) -> FloatArray:
        """Mechanical angle of the x mirror, rad."""

    @property
    def y_rad(self) -> FloatArray:
        """Mechanical angle of the y mirror, rad."""

    @property
    def power_w(self) -> FloatArray:
        """Mean incident power while the gate is on, W."""


MAX_WAIT_S = 3600.0
"""A plan that does not fit after this time with the gate off never fits."""
WAIT_RESOLUTION_S = 1e-3
TICK_ROUNDING_S = 5.01e-7
"""Largest difference from whole PWM periods that rounding to a microsecond makes; one of a microsecond is light."""


def build_cold_budget_state(pixel_count: int, at_s: float = 0.0, stage_count: int = 1) -> BudgetState:
    """Return the budget state of a cold display with all mirrors at their centre."""

    def zero() -> FloatArray:
        return np.zeros(pixel_count)

    since_s = np.full(pixel_count, at_s)
    return BudgetState(
        at_s=at_s,
        begun_s=at_s,
        last_pulse_end_s=since_s,
        rise_k=zero(),
        lower_bound_k=zero(),
        bucket_j=zero(),
        merged_width_s=zero(),
        wall_k=np.zeros((pixel_count, 2)),
        touch_k=np.zeros((pixel_count, 2)),
        nodes_at_s=since_s.copy(),
        inflow_w=zero(),
        exchanged_at_s=-inf,
        panel_k=np.zeros(2),
        panel_at_s=at_s,
        beam_end_s=np.full(stage_count, at_s),
        mirror_rad=np.zeros((stage_count, 2)),
        galvo_mean_square=np.zeros((stage_count, 2)),
        galvo_ringing=np.zeros((stage_count, 2)),
        mirror_at_s=np.full(stage_count, at_s),
        recent_start_s=np.zeros(0),
        recent_width_s=np.zeros(0),
        recent_power_w=np.zeros(0),
        recent_pixel=np.zeros(0, dtype=np.int64),
        recent_stage=np.zeros(0, dtype=np.int64),
    )


def shift_state(state: BudgetState, offset_s: float) -> BudgetState:
    """Return the same state on a time line whose zero lies `offset_s` earlier."""
    return replace(
        state,
        at_s=state.at_s + offset_s,
        begun_s=state.begun_s + offset_s,
        beam_end_s=state.beam_end_s + offset_s,
        last_pulse_end_s=state.last_pulse_end_s + offset_s,
        nodes_at_s=state.nodes_at_s + offset_s,
        exchanged_at_s=state.exchanged_at_s + offset_s,
        panel_at_s=state.panel_at_s + offset_s,
        mirror_at_s=state.mirror_at_s + offset_s,
        recent_start_s=state.recent_start_s + offset_s,
    )


def limit(
    plan: PulsePlan, state: BudgetState, budget: Budget, policy: Policy = "trim"
) -> tuple[LimitedPlan, BudgetState]:
    """Reduce the power of each pulse until it is within all caps. Times and widths do not change.

    The PWM shows in a pulse below full power. Where its last period is not whole, the part that is on may be more than
    its share, and the power is reduced by as much.

    plan.start_s and state.at_s are on the same time line. Returns the limited plan and the state after it.

    Raises OverBudgetError under every policy except "trim" if a pulse would be trimmed. Raises RefusedError under every
    policy if a pulse is wider than the cap or starts before the state's time.
    """
    # "delay" and "refuse" stop at the first pulse above a cap: trimming any is not theirs to decide.
    applied, power_w, cause, workspace = _apply_plan(
        plan.pixel, plan.stage, plan, 0.0, state, budget, TRIM if policy == "trim" else STOP
    )
    if applied < len(plan):
        raise _build_refusal(plan, applied, float(power_w[applied]), REASONS[cause[applied]], state, budget)
    split_w = _allow_for_split_period(plan, power_w, budget)
    split_w[split_w < budget.min_power_w[plan.stage] * (1.0 - TOLERANCE)] = 0.0
    power_w = np.where(power_w < plan.power_w, split_w, power_w)
    columns = {item.name: getattr(plan, item.name) for item in fields(PulsePlan)}
    columns["power_w"] = power_w
    limited = LimitedPlan(
        **columns,
        energy_j=power_w * plan.width_s,
        trimmed_j=(plan.power_w - power_w) * plan.width_s,
        reason=np.array(REASONS)[cause],
        # A pixel without a pulse was hottest at the start of the plan.
        headroom_k=budget.caps.absorber_k - np.maximum(workspace.budgets.peak_k, state.rise_k),
    )
    return limited, close_workspace(workspace, budget)


def _allow_for_split_period(plan: PulsePlan, power_w: FloatArray, budget: Budget) -> FloatArray:
    """Return the powers, [n], W, at which a laser with a PWM, which begins with the pulse, emits the mean of `power_w`.

    Of a last period that is not whole, the part that is on comes first. Of a laser with a curve, it may have all of a
    period's light.
    """
    period_s, full_w = budget.pwm_period_s[plan.stage], budget.heat.power_max_w[plan.stage]
    periods = plan.width_s / period_s
    is_split = np.abs(periods - np.rint(periods)) * period_s > TICK_ROUNDING_S
    whole, on_periods = np.floor(periods), periods * power_w / full_w
    duty = on_periods / (whole + 1.0)
    is_on_to_the_end = (duty > periods - whole) & budget.is_proportional[plan.stage]
    duty = np.where(is_on_to_the_end, (on_periods - (periods - whole)) / np.maximum(whole, 1.0), duty)
    return np.where(is_split, np.minimum(duty * full_w, power_w), power_w)


def compute_wait_s(plan: PulsePlan, state: BudgetState, budget: Budget) -> float:
    """Compute the delay after which the plan fits without trimming, s, or infinity if it never fits."""

    def fits(delay_s: float) -> bool:
        return _apply_plan(plan.pixel, plan.stage, plan, delay_s, state, budget, STOP)[0] == len(plan)

    if fits(0.0):
        return 0.0
    # Bisection needs an end that fits; what does not fit after an hour in the dark never does.
    if not fits(MAX_WAIT_S):
        return inf
    low_s, high_s = 0.0, MAX_WAIT_S
    while high_s - low_s > WAIT_RESOLUTION_S:
        middle_s = 0.5 * (low_s + high_s)
        if fits(middle_s):
            high_s = middle_s
        else:
            low_s = middle_s
    # The later end: it was tested and fits.
    return high_s


def galvo_feasible_prefix(
    plan: PulsePlan, state: BudgetState, budget: Budget, first_row: int = 0, delay_s: float = 0.0
) -> int:
    """Count the pulses before the first one whose move exceeds the galvo cap.

    delay_s: delay of the rows from first_row on
    """
    empty, start_s = np.zeros(0), plan.start_s.copy()
    start_s[first_row:] += delay_s
    budgets = PixelBudgets(
        bucket_j=empty,
        merged_width_s=empty,
        begun_s=empty,
        end_s=state.beam_end_s.copy(),
        peak_k=empty,
        mirror_rad=state.mirror_rad.copy(),
        galvo_mean_square=state.galvo_mean_square.copy(),
        galvo_ringing=state.galvo_ringing.copy(),
        mirror_at_s=state.mirror_at_s.copy(),
    )
    columns = (plan.stage.copy(), start_s, plan.width_s.copy(), plan.x_rad.copy(), plan.y_rad.copy())
    return count_galvo_feasible(budget, budgets, *columns)


def concatenate(batches: list[LimitedPlan], state: BudgetState, budget: Budget) -> LimitedPlan:
    """Concatenate limited batches in order. Without batches, return the empty plan of a display in `state`."""
    if not batches:
        return limit(EMPTY_PLAN, state, budget)[0]
    columns = {
        item.name: np.concatenate([getattr(batch, item.name) for batch in batches]) for item in fields(LimitedPlan)
    }
    columns["headroom_k"] = np.min([batch.headroom_k for batch in batches], axis=0)
    return LimitedPlan(**columns)


def commit_until(
    plan: PulsePlan,
    until_s: float,
    state: BudgetState,
    budget: Budget,
    on_progress: Callable[[], None] = _ignore_progress,
) -> BudgetState:
    """Return the state after the pulses of a plan that start before `until_s`, which count in full."""
    # In full, also a pulse that until_s cuts: the bound may only err upwards.
    count = int(np.searchsorted(plan.start_s, until_s))
    columns = {item.name: getattr(plan, item.name)[:count] for item in fields(PulsePlan)}
    first = PulsePlan(**columns)
    applied = _apply_plan(first.pixel, first.stage, first, 0.0, state, budget, COUNT_ONLY, on_progress)
    return close_workspace(applied[3], budget)


def commit_executed(
    pixel: IntArray, stage: IntArray, pulses: TimedPulses, state: BudgetState, budget: Budget
) -> BudgetState:
    """Return the state after executed pulses [n] in order of their starts, regardless of the caps."""
    return close_workspace(_apply_plan(pixel, stage, pulses, 0.0, state, budget, COUNT_ONLY)[3], budget)


def verify(
    plan: PulsePlan,
    row: IntArray,
    pulses: TimedPulses,
    state: BudgetState,
    budget: Budget,
    on_progress: Callable[[], None] = _ignore_progress,
) -> None:
    """Check pulses [n], decoded from the bytes that are about to be sent, against the caps.

    row: [n] row of the plan to which each pulse belongs. Raises LocalProtocolError if a pulse exceeds a cap.

    The wall-exchange bound depends on its evaluation times. It is therefore evaluated at the plan's own times,
    including those of pulses that were trimmed to zero power.
    """
    is_sent = np.zeros(len(plan), dtype=np.bool)
    is_sent[row] = True
    omitted = np.flatnonzero(~is_sent)
    # Stable: at equal starts the sent pulse comes before the omitted one, as in the plan that was limited.
    order = np.argsort(np.concatenate([pulses.start_s, plan.start_s[omitted]]), kind="stable")
    columns = [
        np.concatenate([getattr(pulses, name), getattr(plan, name)[omitted]]) for name in _EncodedPulses._fields[:-1]
    ]
    power_w = np.concatenate([pulses.power_w, np.zeros(len(omitted))])
    encoded = _EncodedPulses(*(column[order] for column in (*columns, power_w)))
    pixel, stage = (np.concatenate([column[row], column[omitted]])[order] for column in (plan.pixel, plan.stage))
    zero = np.zeros(len(budget.galvos.damping))
    weak = np.flatnonzero((encoded.power_w > 0.0) & (encoded.power_w < budget.min_power_w[stage] * (1.0 - TOLERANCE)))
    if len(weak):
        found, expected_w = encoded.power_w[weak[0]], budget.min_power_w[stage[weak[0]]]
        raise LocalProtocolError(
            f"encoded pulse {order[weak[0]]} on pixel {pixel[weak[0]]} is weaker than its laser emits: "
            f"{found:.4g} W, at least {expected_w:.4g} W"
        )
    # The slack is for the rounding to come; decoded pulses are rounded already, and would pay for it twice.
    exact = budget._replace(galvos=budget.galvos._replace(rad_per_code=zero, timing_slack_s=zero))
    stop_row, allowed_w, cause, _ = _apply_plan(pixel, stage, encoded, 0.0, state, exact, STOP, on_progress)
    if stop_row < len(pixel):
        raise LocalProtocolError(
            f"encoded pulse {order[stop_row]} on pixel {pixel[stop_row]} passes a cap ({REASONS[cause[stop_row]]}): "
            f"{encoded.power_w[stop_row]:.4f} W, allowed {allowed_w[stop_row]:.4f} W"
        )


def _apply_plan(
    pixel: IntArray,
    stage: IntArray,
    pulses: TimedPulses,
    delay_s: float,
    state: BudgetState,
    budget: Budget,
    policy: int,
    on_progress: Callable[[], None] = _ignore_progress,
) -> tuple[int, FloatArray, IntArray, LimiterWorkspace]:
    """Apply pulses [n] in chunks, between which nothing but the workspace is carried over."""
    # Before the first kernel call, which would compile what the second process compiles.
    COLD_START.finish(budget, state)
    count, applied = len(pixel), 0
    workspace = open_workspace(state, count)
    power_w, cause = np.zeros(count), np.zeros(count, dtype=np.int64)
    # Copies are contiguous: a kernel is compiled for one memory layout.
    pixel, stage = pixel.copy(), stage.copy()
    start_s, width_s, requested_w = pulses.start_s + delay_s, pulses.width_s.copy(), pulses.power_w.copy()
    x_rad, y_rad = pulses.x_rad.copy(), pulses.y_rad.copy()
    while applied < count:
        end = min(applied + CHUNK_PULSES, count)
        chunk = slice(applied, end)
        applied += apply_pulses(
            budget,
            workspace,
            pixel[chunk],
            stage[chunk],
            start_s[chunk],
            width_s[chunk],
            x_rad[chunk],
            y_rad[chunk],
            requested_w[chunk],
            policy,
            power_w[chunk],
            cause[chunk],
        )
        if applied < end:
            break
        on_progress()
    return applied, power_w, cause, workspace


def _build_refusal(
    plan: PulsePlan, row: int, allowed_w: float, cap: str, state: BudgetState, budget: Budget
) -> RefusedError:
    pixel, start_s, width_s = int(plan.pixel[row]), float(plan.start_s[row]), float(plan.width_s[row])
    if cap == REASONS[WRONG_ORDER]:
        return RefusedError(f"a pulse at {start_s:.6f} s starts before the budget's time {state.at_s:.6f} s")
    if cap == "pulse_width" and width_s > budget.caps.pulse_width_s:
        width, max_width = (format_quantity(value_s, "s", 6) for value_s in (width_s, budget.caps.pulse_width_s))
        return RefusedError(f"pulse {row} on pixel {pixel} is {width} wide, the cap is {max_width}")
    requested_j, allowed_j, delay_s = (
        plan.power_w[row] * width_s,
        allowed_w * width_s,
        compute_wait_s(plan, state, budget),
    )
    fits = f"the whole fits {delay_s:.3f} s later" if delay_s < inf else "the whole does not fit at any later time"
    return OverBudgetError(
        f"pulse {row} on pixel {pixel} at {start_s:.4f} s requests {format_quantity(requested_j, 'J')}, "
        f"the {CAPS_BY_KEY[cap].message} allows {format_quantity(allowed_j, 'J')}; {fits}",
        pixel=pixel,
        cap=cap,
        margin_j=float(requested_j - allowed_j),
        fits_after_s=delay_s,
    )
