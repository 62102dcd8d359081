"""(PulsePlan, BudgetState) → (LimitedPlan, BudgetState): no pulse passes that a cap does not allow.

Caps bound a region of absorbers, walls and touch surfaces that the dark never leaves: walls are never let warmer than
the touch surface bears for ever. So it is enough to look at each pulse's end; nothing already accepted can make a
later moment too warm.
"""

from dataclasses import fields, replace
from math import inf
from typing import NamedTuple, Protocol

import numpy as np

from optodrive.core.errors import LocalProtocolError, OverBudgetError, RefusedError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import EMPTY_PLAN, BudgetState, LimitedPlan, PulsePlan
from optodrive.core.types.policy import Policy
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.caps import CAPS_BY_KEY, REASONS, WRONG_ORDER
from optodrive.planning.limiter.galvo_moves import count_galvo_feasible
from optodrive.planning.limiter.pulse_application import (
    COUNT_ONLY,
    STOP,
    TRIM,
    apply_pulses,
)
from optodrive.planning.limiter.workspace import LimiterWorkspace, PixelBudgets, close_workspace, open_workspace


class _EncodedPulses(NamedTuple):
    """Encoded pulses, and without power those that leave dark; all [n]."""

    start_s: FloatArray
    width_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray
    power_w: FloatArray


class TimedPulses(Protocol):
    """What the beam does, pulse by pulse; all [n]."""

    @property
    def start_s(self) -> FloatArray:
        """Gate on."""

    @property
    def width_s(self) -> FloatArray:
        """Gate-on time."""

    @property
    def x_rad(self) -> FloatArray:
        """Mechanical mirror angle."""

    @property
    def y_rad(self) -> FloatArray:
        """Mechanical mirror angle."""

    @property
    def power_w(self) -> FloatArray:
        """Mean incident power while on."""


MAX_WAIT_S = 3600.0
"""What does not fit after an hour in the dark never does."""
WAIT_RESOLUTION_S = 1e-3


def cold_state(pixel_count: int, at_s: float = 0.0) -> BudgetState:
    """A display at rest, its mirrors in the middle."""

    def zero() -> FloatArray:
        return np.zeros(pixel_count)

    since_s = np.full(pixel_count, at_s)
    return BudgetState(
        at_s=at_s,
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
        mirror_rad=np.zeros(2),
        galvo_mean_square=np.zeros(2),
        galvo_ringing=np.zeros(2),
        mirror_at_s=at_s,
        recent_start_s=np.zeros(0),
        recent_width_s=np.zeros(0),
        recent_power_w=np.zeros(0),
        recent_pixel=np.zeros(0, dtype=np.int64),
    )


def shift_state(state: BudgetState, offset_s: float) -> BudgetState:
    """The same state on a time line whose zero lies offset_s earlier."""
    return replace(
        state,
        at_s=state.at_s + offset_s,
        last_pulse_end_s=state.last_pulse_end_s + offset_s,
        nodes_at_s=state.nodes_at_s + offset_s,
        exchanged_at_s=state.exchanged_at_s + offset_s,
        mirror_at_s=state.mirror_at_s + offset_s,
        recent_start_s=state.recent_start_s + offset_s,
    )


def limit(
    plan: PulsePlan, state: BudgetState, budget: Budget, policy: Policy = "trim"
) -> tuple[LimitedPlan, BudgetState]:
    """Take from each pulse's power what the caps do not allow; times and widths stay.

    plan.start_s and state.at_s share one time line. Raises OverBudgetError where a pulse would be trimmed under any
    other policy than "trim", and RefusedError at any time where a pulse is wider than the cap or starts before the
    state's time.
    """
    applied, power_w, cause, workspace = _apply_plan(
        plan.pixel, plan, 0.0, state, budget, TRIM if policy == "trim" else STOP
    )
    if applied < len(plan):
        raise _build_refusal(plan, applied, float(power_w[applied]), REASONS[cause[applied]], state, budget)
    columns = {item.name: getattr(plan, item.name) for item in fields(PulsePlan)}
    columns["power_w"] = power_w
    limited = LimitedPlan(
        **columns,
        energy_j=power_w * plan.width_s,
        trimmed_j=(plan.power_w - power_w) * plan.width_s,
        reason=np.array(REASONS)[cause],
        headroom_k=budget.caps.absorber_k - np.maximum(workspace.budgets.peak_k, state.rise_k),
    )
    return limited, close_workspace(workspace, budget)


def compute_wait_s(plan: PulsePlan, state: BudgetState, budget: Budget) -> float:
    """How much later the plan would have to come to fit untrimmed, s; infinite where it never does."""

    def fits(delay_s: float) -> bool:
        return _apply_plan(plan.pixel, plan, delay_s, state, budget, STOP)[0] == len(plan)

    if fits(0.0):
        return 0.0
    if not fits(MAX_WAIT_S):
        return inf
    low_s, high_s = 0.0, MAX_WAIT_S
    while high_s - low_s > WAIT_RESOLUTION_S:
        middle_s = 0.5 * (low_s + high_s)
        if fits(middle_s):
            high_s = middle_s
        else:
            low_s = middle_s
    return high_s


def galvo_feasible_prefix(plan: PulsePlan, state: BudgetState, budget: Budget, delay_s: float = 0.0) -> int:
    """How many of a plan's first pulses have moves that the mirrors bear, if the plan comes later_s later."""
    empty = np.zeros(0)
    budgets = PixelBudgets(
        bucket_j=empty,
        merged_width_s=empty,
        end_s=np.array([state.at_s]),
        peak_k=empty,
        mirror_rad=state.mirror_rad.copy(),
        galvo_mean_square=state.galvo_mean_square.copy(),
        galvo_ringing=state.galvo_ringing.copy(),
        mirror_at_s=np.array([state.mirror_at_s]),
    )
    columns = (plan.start_s + delay_s, plan.width_s.copy(), plan.x_rad.copy(), plan.y_rad.copy())
    return count_galvo_feasible(budget, budgets, *columns)


def concatenate(batches: list[LimitedPlan], state: BudgetState, budget: Budget) -> LimitedPlan:
    """One plan of limited pieces, in order; without any, the empty plan of a display in `state`."""
    if not batches:
        return limit(EMPTY_PLAN, state, budget)[0]
    columns = {
        item.name: np.concatenate([getattr(piece, item.name) for piece in batches]) for item in fields(LimitedPlan)
    }
    columns["headroom_k"] = np.min([piece.headroom_k for piece in batches], axis=0)
    return LimitedPlan(**columns)


def commit_until(plan: LimitedPlan, until_s: float, state: BudgetState, budget: Budget) -> BudgetState:
    """What a plan leaves of which no pulse from until_s on was fired: the earlier ones count in full."""
    count = int(np.searchsorted(plan.start_s, until_s))
    columns = {item.name: getattr(plan, item.name)[:count] for item in fields(PulsePlan)}
    return close_workspace(
        _apply_plan(plan.pixel[:count], PulsePlan(**columns), 0.0, state, budget, COUNT_ONLY)[3], budget
    )


def commit_executed(pixel: IntArray, pulses: TimedPulses, state: BudgetState, budget: Budget) -> BudgetState:
    """What pulses [n] leave that were fired, in order of time, whatever the caps say."""
    return close_workspace(_apply_plan(pixel, pulses, 0.0, state, budget, COUNT_ONLY)[3], budget)


def verify(plan: PulsePlan, row: IntArray, pulses: TimedPulses, state: BudgetState, budget: Budget) -> None:
    """Check pulses [n] as decoded from the very bytes that are about to leave; row: the plan's pulse each is part of.

    Raises LocalProtocolError if any passes a cap. Every bound holds, but the heat between walls is bounded a little
    otherwise the more often it is reckoned: so it is where the plan's own was, also where its pulses leave dark.
    """
    omitted = np.setdiff1d(np.arange(len(plan)), row)
    order = np.argsort(np.concatenate([pulses.start_s, plan.start_s[omitted]]), kind="stable")
    columns = [
        np.concatenate([getattr(pulses, name), getattr(plan, name)[omitted]]) for name in _EncodedPulses._fields[:-1]
    ]
    power_w = np.concatenate([pulses.power_w, np.zeros(len(omitted))])
    encoded = _EncodedPulses(*(column[order] for column in (*columns, power_w)))
    pixel = np.concatenate([plan.pixel[row], plan.pixel[omitted]])[order]
    exact = budget._replace(galvo=budget.galvo._replace(code_step_rad=0.0, interval_shrink_s=0.0))
    stop_row, allowed_w, cause, _ = _apply_plan(pixel, encoded, 0.0, state, exact, STOP)
    if stop_row < len(pixel):
        raise LocalProtocolError(
            f"encoded pulse {order[stop_row]} on pixel {pixel[stop_row]} passes a cap ({REASONS[cause[stop_row]]}): "
            f"{encoded.power_w[stop_row]:.4f} W, allowed {allowed_w[stop_row]:.4f} W"
        )


def _apply_plan(
    pixel: IntArray, pulses: TimedPulses, delay_s: float, state: BudgetState, budget: Budget, policy: int
) -> tuple[int, FloatArray, IntArray, LimiterWorkspace]:
    count = len(pixel)
    workspace = open_workspace(state, count)
    power_w, cause = np.zeros(count), np.zeros(count, dtype=np.int64)
    # Copies, because a kernel is compiled for one layout of its arrays.
    applied = apply_pulses(
        budget,
        workspace,
        pixel.copy(),
        pulses.start_s + delay_s,
        pulses.width_s.copy(),
        pulses.x_rad.copy(),
        pulses.y_rad.copy(),
        pulses.power_w.copy(),
        policy,
        power_w,
        cause,
    )
    return applied, power_w, cause, workspace


def _build_refusal(
    plan: PulsePlan, row: int, allowed_w: float, cap: str, state: BudgetState, budget: Budget
) -> RefusedError:
    pixel, start_s, width_s = int(plan.pixel[row]), float(plan.start_s[row]), float(plan.width_s[row])
    if cap == REASONS[WRONG_ORDER]:
        return RefusedError(f"a pulse at {start_s:.6f} s starts before the budget's time {state.at_s:.6f} s")
    if cap == "pulse_width" and width_s > budget.caps.pulse_width_s:
        max_ms = budget.caps.pulse_width_s * 1e3
        return RefusedError(f"pulse {row} on pixel {pixel} is {width_s * 1e3:.3f} ms wide, the cap is {max_ms:.3f} ms")
    requested_j, allowed_j, delay_s = (
        plan.power_w[row] * width_s,
        allowed_w * width_s,
        compute_wait_s(plan, state, budget),
    )
    fits = f"the whole fits {delay_s:.3f} s later" if delay_s < inf else "the whole does not fit at any later time"
    return OverBudgetError(
        f"pulse {row} on pixel {pixel} at {start_s:.4f} s asks for {requested_j * 1e3:.2f} mJ, "
        f"the {CAPS_BY_KEY[cap].message} allows {allowed_j * 1e3:.2f} mJ; {fits}",
        pixel=pixel,
        cap=cap,
        margin_j=float(requested_j - allowed_j),
        earliest_s=delay_s,
    )
