"""(PulsePlan, BudgetState) → (LimitedPlan, BudgetState): no pulse passes that a cap does not allow."""

from dataclasses import fields, replace
from typing import Literal

import numpy as np

from optodrive.errors import LocalProtocolError, RefusedError
from optodrive.flow import EMPTY_PLAN, BudgetState, FloatArray, LimitedPlan, PulsePlan
from optodrive.limit.budget import Budget, EnergyWindow, decayed_k, heated_k, power_for_rise_w

Policy = Literal["trim", "refuse"]

REASONS = {
    "absorber_temperature": "absorber temperature cap",
    "pulse_width": "pulse width cap, counting pulses without a rest between them as one,",
    "pulse_energy": "pulse energy cap",
    "spot_energy": "energy that may stay in a pixel's bucket",
    "pixel_mean_power": "pixel mean power cap",
    "display_mean_power": "display mean power cap",
}
ROUNDING = 1e-9
"""Relative excess that floating-point rounding may cause; anything larger is a real excess."""


def fresh_state(pixel_count: int, at_s: float = 0.0) -> BudgetState:
    """A display at rest."""
    zero, never_s = np.zeros(pixel_count), np.full(pixel_count, -np.inf)
    return BudgetState(at_s=at_s, rise_k=zero, spot_j=zero, on_s=zero, dark_since_s=never_s)


def shifted(state: BudgetState, offset_s: float) -> BudgetState:
    """The same state on a time line whose zero lies offset_s earlier."""
    return replace(
        state,
        at_s=state.at_s + offset_s,
        dark_since_s=state.dark_since_s + offset_s,
        recent_start_s=state.recent_start_s + offset_s,
    )


def limit(
    plan: PulsePlan, state: BudgetState, budget: Budget, policy: Policy = "trim"
) -> tuple[LimitedPlan, BudgetState]:
    """Take from each pulse's power what the caps do not allow; times and widths stay.

    plan.start_s and state.at_s share one time line. Raises RefusedError under policy "refuse" where a pulse would be
    trimmed, and at any time where a pulse is wider than the cap or starts before the state's time.
    """
    ledger = _Ledger(state, budget)
    power_w = np.empty(len(plan))
    reason: list[str] = []
    for row, (pixel, start_s, width_s, asked_w) in enumerate(
        zip(plan.pixel.tolist(), plan.start_s.tolist(), plan.width_s.tolist(), plan.power_w.tolist(), strict=True)
    ):
        if width_s > budget.pulse_width_max_s * (1 + ROUNDING):
            raise RefusedError(
                f"pulse {row} on pixel {pixel} is {width_s * 1e3:.3f} ms wide, "
                f"the cap is {budget.pulse_width_max_s * 1e3:.3f} ms"
            )
        allowed_w, cause = ledger.allowed(pixel, start_s, width_s)
        if asked_w > allowed_w * (1 + ROUNDING):
            if policy == "refuse":
                raise RefusedError(
                    f"pulse {row} on pixel {pixel} at {start_s:.4f} s asks for {asked_w * width_s * 1e3:.2f} mJ, "
                    f"the {REASONS[cause]} allows {max(0.0, allowed_w) * width_s * 1e3:.2f} mJ"
                )
            power_w[row] = max(0.0, allowed_w)
            reason.append(cause)
        else:
            power_w[row] = asked_w
            reason.append("")
        ledger.fire(pixel, start_s, width_s, power_w[row])
    columns = {item.name: getattr(plan, item.name) for item in fields(PulsePlan)}
    columns["power_w"] = power_w
    limited = LimitedPlan(
        **columns,
        energy_j=power_w * plan.width_s,
        trimmed_j=(plan.power_w - power_w) * plan.width_s,
        reason=np.array(reason, dtype=np.str_),
        headroom_k=ledger.headroom_k(),
    )
    return limited, ledger.state()


def joined(pieces: list[LimitedPlan], state: BudgetState, budget: Budget) -> LimitedPlan:
    """One plan of limited pieces, in order; without any, the empty plan of a display in `state`."""
    if not pieces:
        return limit(EMPTY_PLAN, state, budget)[0]
    columns = {
        item.name: np.concatenate([getattr(piece, item.name) for piece in pieces]) for item in fields(LimitedPlan)
    }
    columns["headroom_k"] = np.min([piece.headroom_k for piece in pieces], axis=0)
    return LimitedPlan(**columns)


def fired(plan: LimitedPlan, until_s: float, state: BudgetState, budget: Budget) -> BudgetState:
    """What a plan leaves of which no pulse from until_s on was fired: the earlier ones count in full."""
    ledger = _Ledger(state, budget)
    columns = (plan.pixel, plan.start_s, plan.width_s, plan.power_w)
    for pixel, start_s, width_s, power_w in zip(*(column.tolist() for column in columns), strict=True):
        if start_s >= until_s:
            break
        ledger.fire(pixel, start_s, width_s, power_w)
    return ledger.state()


def verify(
    pixel: list[int],
    start_s: FloatArray,
    width_s: FloatArray,
    power_w: FloatArray,
    state: BudgetState,
    budget: Budget,
) -> None:
    """Check pulses as decoded from the very bytes that are about to leave; LocalProtocolError if any passes a cap."""
    ledger = _Ledger(state, budget)
    columns = zip(pixel, start_s.tolist(), width_s.tolist(), power_w.tolist(), strict=True)
    for row, (index, start, width, power) in enumerate(columns):
        allowed_w, cause = ledger.allowed(index, start, width)
        if power > max(0.0, allowed_w) * (1 + ROUNDING) or width > budget.pulse_width_max_s * (1 + ROUNDING):
            raise LocalProtocolError(
                f"encoded pulse {row} on pixel {index} passes a cap ({cause}): {power:.4f} W, allowed {allowed_w:.4f} W"
            )
        ledger.fire(index, start, width, power)


class _Spot:
    """One pixel while a plan is walked through."""

    __slots__ = ("at_s", "bucket_j", "dark_since_s", "gain_k_per_w", "on_s", "peak_k", "rise_k", "tau_s", "window")

    def __init__(self, state: BudgetState, budget: Budget, pixel: int) -> None:
        self.at_s = state.at_s
        self.rise_k = self.peak_k = float(state.rise_k[pixel])
        self.bucket_j = float(state.spot_j[pixel])
        self.on_s = float(state.on_s[pixel])
        self.dark_since_s = float(state.dark_since_s[pixel])
        self.gain_k_per_w = float(budget.gain_k_per_w[pixel])
        self.tau_s = float(budget.tau_s[pixel])
        self.window = EnergyWindow(budget.pixel_mean_window_s, budget.pixel_mean_power_max_w)

    def at(self, start_s: float, budget: Budget) -> tuple[float, float, float]:
        """Bound on the rise (K), bucket (J) and light without a rest (s) as a pulse begins."""
        dark_s = start_s - self.at_s
        rested = start_s - self.dark_since_s >= budget.pulse_rest_min_s - ROUNDING
        return (
            decayed_k(self.rise_k, dark_s, self.tau_s),
            max(0.0, self.bucket_j - dark_s * budget.pixel_mean_power_max_w),
            0.0 if rested else self.on_s,
        )


class _Ledger:
    """The state while a plan is walked through: what each pixel touched so far holds, and the display's window."""

    def __init__(self, state: BudgetState, budget: Budget) -> None:
        self._budget = budget
        self._initial = state
        self._end_s = state.at_s
        self._display = EnergyWindow(budget.display_mean_window_s, budget.display_mean_power_max_w)
        self._spots: dict[int, _Spot] = {}
        self._fired: list[tuple[float, float, float, int]] = []
        recent = (state.recent_start_s, state.recent_width_s, state.recent_power_w, state.recent_pixel)
        for start_s, width_s, power_w, pixel in zip(*(column.tolist() for column in recent), strict=True):
            self._count(start_s, width_s, power_w, pixel)

    def _spot(self, pixel: int) -> _Spot:
        spot = self._spots.get(pixel)
        if spot is None:
            spot = self._spots[pixel] = _Spot(self._initial, self._budget, pixel)
        return spot

    def _count(self, start_s: float, width_s: float, power_w: float, pixel: int) -> None:
        self._display.add(start_s, width_s, power_w)
        self._spot(pixel).window.add(start_s, width_s, power_w)
        self._fired.append((start_s, width_s, power_w, pixel))

    def allowed(self, pixel: int, start_s: float, width_s: float) -> tuple[float, str]:
        """Largest power the caps allow this pulse, W, and the cap that binds."""
        if start_s < self._end_s - ROUNDING:
            raise RefusedError(f"a pulse at {start_s:.6f} s starts before the budget's time {self._end_s:.6f} s")
        budget, spot = self._budget, self._spot(pixel)
        rise_k, bucket_j, on_s = spot.at(start_s, budget)
        if on_s + width_s > budget.pulse_width_max_s + ROUNDING:
            return 0.0, "pulse_width"
        return min(
            (
                power_for_rise_w(rise_k, budget.rise_cap_k, width_s, spot.gain_k_per_w, spot.tau_s),
                "absorber_temperature",
            ),
            (budget.pulse_energy_max_j / width_s, "pulse_energy"),
            ((budget.pulse_energy_max_j - bucket_j) / width_s, "spot_energy"),
            (spot.window.allowed_w(start_s, width_s), "pixel_mean_power"),
            (self._display.allowed_w(start_s, width_s), "display_mean_power"),
        )

    def fire(self, pixel: int, start_s: float, width_s: float, power_w: float) -> None:
        """Count a pulse as fired; one trimmed to nothing is not fired."""
        if power_w <= 0.0:
            return
        budget, spot = self._budget, self._spot(pixel)
        rise_k, bucket_j, on_s = spot.at(start_s, budget)
        end_s = start_s + width_s
        spot.rise_k = heated_k(rise_k, power_w, width_s, spot.gain_k_per_w, spot.tau_s)
        spot.peak_k = max(spot.peak_k, spot.rise_k)
        spot.bucket_j = max(0.0, bucket_j + (power_w - budget.pixel_mean_power_max_w) * width_s)
        spot.on_s, spot.dark_since_s = on_s + width_s, end_s
        spot.at_s = self._end_s = end_s
        self._count(start_s, width_s, power_w, pixel)

    def headroom_k(self) -> FloatArray:
        """[p] least distance of each bound from the cap so far, K."""
        peak_k = self._initial.rise_k.copy()
        for pixel, spot in self._spots.items():
            peak_k[pixel] = spot.peak_k
        return self._budget.rise_cap_k - peak_k

    def state(self) -> BudgetState:
        """Everything a next plan must know."""
        budget, initial, at_s = self._budget, self._initial, self._end_s
        rise_k = initial.rise_k * np.exp((initial.at_s - at_s) / budget.tau_s)
        spot_j = np.maximum(0.0, initial.spot_j - (at_s - initial.at_s) * budget.pixel_mean_power_max_w)
        on_s, dark_since_s = initial.on_s.copy(), initial.dark_since_s.copy()
        for pixel, spot in self._spots.items():
            rise_k[pixel], spot_j[pixel], _ = spot.at(at_s, budget)
            on_s[pixel], dark_since_s[pixel] = spot.on_s, spot.dark_since_s
        horizon_s = at_s - max(budget.pixel_mean_window_s, budget.display_mean_window_s)
        recent = [pulse for pulse in self._fired if pulse[0] + pulse[1] > horizon_s]
        start_s, width_s, power_w, pixels = zip(*recent, strict=True) if recent else ((),) * 4
        return BudgetState(
            at_s=at_s,
            rise_k=rise_k,
            spot_j=spot_j,
            on_s=on_s,
            dark_since_s=dark_since_s,
            recent_start_s=np.array(start_s, dtype=np.float64),
            recent_width_s=np.array(width_s, dtype=np.float64),
            recent_power_w=np.array(power_w, dtype=np.float64),
            recent_pixel=np.array(pixels, dtype=np.int64),
        )
