"""Exclusive access to a board for one task: it is armed once and executes points and plans that the limiter has passed.

`close` sends ABORT. If the board does not receive it, the closed port and the lease turn the gate off.
"""

import gc
import sys
from collections.abc import Callable
from math import ceil, inf, pi
from types import TracebackType
from typing import Self

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import (
    BoardFaultError,
    InputError,
    LinkError,
    LocalProtocolError,
    NotReadyError,
    OverBudgetError,
    Unquoted,
)
from optodrive.core.quantity import format_number, format_quantity
from optodrive.core.scheduling import LIGHT, set_realtime_priority
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan, PulsePlan
from optodrive.device.config import Config, build_pixel_layout
from optodrive.link.board_setup import build_bench_requirements
from optodrive.link.protocol.quantisation import CENTRE_CODE, DUTY_MAX, WirePoints, decode, quantise
from optodrive.link.protocol.states import BoardState
from optodrive.link.session.fault_hints import get_fault_hint
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.base import Transport
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import limit, shift_state, verify

LOOP_STEP_S = 0.002
SWITCH_INTERVAL_S = 2e-4
"""As in the engine: a computing thread must not delay the lease."""
FIELD_MARGIN_M = 4e-3
"""Permitted margin beyond the outermost pixels; the error of an uncorrected beam is smaller."""
HALF_TRAVEL_MIN_M = 3e-3
"""Shortest way of a mirror from the centre that shows its travel; a smaller display is left by as much."""
SPOT_POWER_MAX_W = 0.05
"""Maximum power of a spot: 2 % of a pixel's drive power; steady on one absorber it adds a few kelvin."""
SPOT_SHARE_MAX = 0.05
"""Maximum power of a spot relative to the laser's power."""
SPOT_WIDTH_S = 0.02
START_LEAD_S = 0.03
SETTLING_TIME_CONSTANTS = 15.0
"""Settling time after a move in time constants of the servo."""
ARM_TIMEOUT_S = 4.0
STATUS_TIMEOUT_S = 2.0
POINT_TIMEOUT_S = 3.0
FAULT_NAME_TIMEOUT_S = 0.5


def _ignore_reports(job: PlanJob) -> None:
    pass


class ExclusiveBoard:
    """A board and its session. Methods raise LinkError, BoardFaultError or NotReadyError when the task must end."""

    def __init__(self, display: DisplayModel, transport: Transport, clock: Clock) -> None:
        self._display, self._clock = display, clock
        config = display.config
        self.requirements = build_bench_requirements(config, FIELD_MARGIN_M)
        self._limits = self.requirements.limits
        self.session = BoardSession(transport, clock, self.requirements)
        self._state = display.build_cold_state()[1]
        self._timeline_zero_s: float | None = None
        self._accounted_pixel = find_weakest_pixel(display)
        self._settling_s, self._width_s = max_settling_s(config), spot_width_s(config)
        # The mirrors leave for a single point when it begins, which is earlier than the lead-in of a plan.
        leaving_s = np.full_like(display.budget.galvos.lead_in_s, self._settling_s)
        self._point_budget = display.budget._replace(galvos=display.budget.galvos._replace(lead_in_s=leaving_s))
        self._arm_requested = self._armed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def display(self) -> DisplayModel:
        """The display that the limiter computes with."""
        return self._display

    @property
    def config(self) -> Config:
        """Configuration of the display."""
        return self._display.config

    def connect(self) -> None:
        """Open the link and begin a session. Kernels are loaded first, because compilation would delay the lease."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        set_realtime_priority(LIGHT)
        limit(self._plan(0.0, 0.0, self.zero_duty_power_w), self._state, self._display.budget)
        gc.collect()
        gc.freeze()
        self.session.connect()
        until_s = self._clock.now_s() + STATUS_TIMEOUT_S
        while self.session.board.temperature_c is None:  # until the first STATUS, which has faults and inputs
            self.session.step(LOOP_STEP_S, renew_lease=False)
            if self._clock.now_s() > until_s:
                raise LinkError(f"{self.session.port}: the board sent no STATUS within {STATUS_TIMEOUT_S:g} s")

    def close(self) -> None:
        """Send ABORT and close the link."""
        self._arm_requested = self._armed = False
        self.session.close()

    def step(self) -> None:
        """Renew the lease and process messages for LOOP_STEP_S.

        Raise BoardFaultError if the board left its armed states, NotReadyError if it refused a message.
        """
        self.session.step(LOOP_STEP_S, renew_lease=True)
        board, refusal = self.session.board, self.session.pop_refusal()
        if board.state == BoardState.FAULT and self._arm_requested:
            raise self._build_fault_error()
        if refusal is not None:
            raise NotReadyError(f"the board refuses: {refusal}")
        if self._armed and board.state in (BoardState.DISARMED, BoardState.ARMING):
            raise BoardFaultError(f"the board went to {board.state} by itself: {self.session.last_event_reason}")

    def _build_fault_error(self) -> BoardFaultError:
        """Build the error with the fault's name, which a STATUS reports soon after the ACK that reported FAULT."""
        until_s = self._clock.now_s() + FAULT_NAME_TIMEOUT_S
        while not self.session.board.fault and self._clock.now_s() < until_s:
            self.session.step(LOOP_STEP_S, renew_lease=False)
        fault = self.session.board.fault
        return BoardFaultError(f"the board went to FAULT {fault}: {get_fault_hint(fault)}")

    def wait(self, duration_s: float) -> None:
        """Wait and keep the lease."""
        until_s = self._clock.now_s() + duration_s
        while self._clock.now_s() < until_s:
            self.step()

    def arm(self) -> float:
        """Arm the board and return the time from the request to ARMED, s.

        The indicator is on for two seconds of it.
        """
        start_s = self._clock.now_s()
        self.session.arm()
        self._arm_requested = True
        while self.session.board.state != BoardState.ARMED:
            self.step()
            if self._clock.now_s() - start_s > ARM_TIMEOUT_S:
                raise NotReadyError(f"the board did not arm within {ARM_TIMEOUT_S:g} s: {self.session.board.state}")
        self._armed = True
        return self._clock.now_s() - start_s

    def disarm(self) -> None:
        """Disarm, acknowledge a fault, and wait for DISARMED. Raise NotReadyError if the board refuses."""
        self._arm_requested = self._armed = False
        self.session.disarm()
        until_s = self._clock.now_s() + ARM_TIMEOUT_S
        while self.session.board.state != BoardState.DISARMED:
            self.session.step(LOOP_STEP_S, renew_lease=False)
            refusal = self.session.pop_refusal()
            if refusal is not None:
                raise NotReadyError(f"the board refuses to disarm: {refusal}")
            if self._clock.now_s() > until_s:
                raise LinkError(f"the board does not report DISARMED: {self.session.board.state}")

    # --- points -------------------------------------------------------------------------------------------------

    def move_to(self, x_code: int, y_code: int) -> None:
        """Move the mirrors with the gate off and wait until they have settled."""
        self._execute_point(x_code, y_code, self.zero_duty_power_w, gate_on=False)

    def fire_spot(self, x_code: int, y_code: int, power_w: float) -> None:
        """Emit one short pulse with settled mirrors and wait until the board has reported it in full."""
        check_spot_power(self.config, power_w)
        self._execute_point(x_code, y_code, power_w, gate_on=True)

    def play(self, plan: PulsePlan, on_reported: Callable[[PlanJob], None]) -> None:
        """Play a plan once it fits all caps without trimming, and wait until the board has reported it in full.

        on_reported: called with the job when further pulses are reported; it must not block. Raises OverBudgetError if
        the plan never fits, and BoardFaultError if the board kept the gate on for another time than planned.
        """
        self._require_ready()
        limited, before, after, start_s = self._limit_when_feasible(plan)
        points = quantise(limited, self.session.scale)
        self._verify_encoded(points, limited, before, len(limited))
        self._state, self._timeline_zero_s = after, start_s
        self._timeline_zero_s += self._stream(points, limited, start_s, gate_on=True, on_reported=on_reported)

    def _require_ready(self) -> None:
        if not self._armed:
            raise NotReadyError(f"the board is not armed: {self.session.board.state}")
        until_s = self._clock.now_s() + POINT_TIMEOUT_S
        while not self.session.is_ready:
            self.step()
            if self._clock.now_s() > until_s:
                raise LinkError(f"{self.session.port}: the board was not ready within {POINT_TIMEOUT_S:g} s")

    def play_gate_off(self, plan: PulsePlan, points: WirePoints) -> IntArray:
        """Play points that never turn the gate on, and return the board tick at the end of each point, [n].

        plan: the mirrors' moves as pulses of no power, for the limiter; points: the same moves on the wire, each with a
        row of its own. Raises LocalProtocolError, before anything is sent, if a point would turn the gate on, and
        OverBudgetError if the moves never fit the galvo cap.
        """
        self._require_ready()
        limited, before, after, start_s = self._limit_when_feasible(plan)
        self._verify_encoded(points, limited, before, 0)
        self._state, self._timeline_zero_s = after, start_s
        job = self._run_job(points, start_s)
        end_tick: IntArray = job.read_reported(0, len(points)).on_tick
        planned_end = job.start_tick + points.compute_end_ticks()
        self._timeline_zero_s += max(0.0, float(end_tick[-1] - planned_end[-1]) * self.session.scale.tick_s)
        return end_tick

    @property
    def zero_duty_power_w(self) -> float:
        """Power that rounds to duty 0: the gate stays off, while the limiter still counts the move."""
        return 0.5 * self.config.laser.max_power_w / DUTY_MAX

    def _plan(self, x_rad: float, y_rad: float, power_w: float) -> PulsePlan:
        """Build a plan of one pulse, accounted to the weakest pixel because the pixel it hits is unknown."""
        return PulsePlan(
            start_s=np.array([self._settling_s]),
            width_s=np.array([self._width_s]),
            x_rad=np.array([x_rad]),
            y_rad=np.array([y_rad]),
            power_w=np.array([power_w]),
            pixel=np.array([self._accounted_pixel]),
            settling_s=np.array([self._settling_s]),
            target_m=np.array([np.nan]),
            requested_start_s=np.array([self._settling_s]),
            source=np.array([0]),
            stage=np.array([0]),
        )

    def _execute_point(self, x_code: int, y_code: int, power_w: float, gate_on: bool) -> None:
        self.check_range(x_code, y_code)
        self._require_ready()
        scale = self.session.scale
        x_rad, y_rad = scale.to_angles_rad(np.array([x_code, y_code]))
        plan = self._plan(x_rad, y_rad, power_w)
        limited, before, after, start_s = self._limit_when_feasible(plan, self._point_budget)
        points = quantise(limited, scale)
        self._verify_encoded(points, limited, before, int(gate_on), self._point_budget)
        self._state, self._timeline_zero_s = after, start_s
        self._timeline_zero_s += self._stream(points, limited, start_s, gate_on)

    def check_range(self, x_code: int, y_code: int) -> None:
        """Raise InputError for codes beyond the display and its margin."""
        limits = self._limits
        for axis, code in (("x", x_code), ("y", y_code)):
            low, high = getattr(limits, f"{axis}_min"), getattr(limits, f"{axis}_max")
            if not low <= code <= high:
                raise InputError(
                    f"{axis}_code",
                    code,
                    f"{low} to {high}, the display and {format_quantity(FIELD_MARGIN_M, 'm')} more",
                )

    @property
    def half_travel_codes(self) -> tuple[int, int]:
        """Way of mirrors x and y from the centre to either side that spans the display, within the board's range."""
        layout, scanner, limits = build_pixel_layout(self.config.display), self.config.scanner, self._limits
        code_m = 2.0 * scanner.focal_length_m * scanner.rad_per_code
        x_codes, y_codes = (
            round(max(float(np.abs(axis_m).max()), HALF_TRAVEL_MIN_M) / code_m) for axis_m in (layout.x_m, layout.y_m)
        )
        return (
            min(x_codes, limits.x_max - CENTRE_CODE, CENTRE_CODE - limits.x_min),
            min(y_codes, limits.y_max - CENTRE_CODE, CENTRE_CODE - limits.y_min),
        )

    def clip_codes(self, codes: FloatArray) -> FloatArray:
        """Clip codes [k, 2] to the board's range."""
        limits = self._limits
        return np.clip(codes, [limits.x_min, limits.y_min], [limits.x_max, limits.y_max])

    def _limit_when_feasible(
        self, plan: PulsePlan, budget: Budget | None = None
    ) -> tuple[LimitedPlan, BudgetState, BudgetState, float]:
        """Wait until the limiter passes the plan. Return it with the state before and after, and its start, s."""
        while True:
            start_s = self.session.board_s() + START_LEAD_S
            before = shift_state(
                self._state, (start_s if self._timeline_zero_s is None else self._timeline_zero_s) - start_s
            )
            try:
                limited, after = limit(plan, before, budget or self._display.budget, "refuse")
            except OverBudgetError as error:
                if error.fits_after_s == inf:
                    raise
                self.wait(error.fits_after_s)
                continue
            return limited, before, after, start_s

    def _verify_encoded(
        self, points: WirePoints, plan: LimitedPlan, before: BudgetState, pulses: int, budget: Budget | None = None
    ) -> None:
        """Decode the encoded points and verify them against the budget."""
        decoded = decode(points.encode_payload(), self.session.scale)
        if len(decoded.index) != pulses:
            raise LocalProtocolError(f"{len(decoded.index)} points with the gate on, expected {pulses}")
        verify(plan, points.row[decoded.index], decoded, before, budget or self._display.budget)

    def _stream(
        self,
        points: WirePoints,
        plan: LimitedPlan,
        start_s: float,
        gate_on: bool,
        on_reported: Callable[[PlanJob], None] = _ignore_reports,
    ) -> float:
        """Stream points, wait for their reports, and return their delay, s."""
        job = self._run_job(points, start_s, on_reported)
        executed = job.build_executed(plan, self.session.scale.full_power_w, self.session.scale.tick_s)
        if gate_on and not np.allclose(executed.width_s, plan.width_s):
            raise BoardFaultError(
                f"the board kept the gate on for {executed.width_s.sum():g} s; expected {plan.width_s.sum():g} s"
            )
        ended_s = float(executed.start_s[-1] + executed.width_s[-1])
        return max(0.0, ended_s - float(plan.start_s[-1] + plan.width_s[-1]))

    def _run_job(
        self, points: WirePoints, start_s: float, on_reported: Callable[[PlanJob], None] = _ignore_reports
    ) -> PlanJob:
        """Stream points and wait until the board has reported all of them."""
        job = self.session.begin(points, start_s)
        duration_s = float(points.compute_end_ticks()[-1]) * self.session.scale.tick_s
        until_s = self._clock.now_s() + duration_s + POINT_TIMEOUT_S
        reported = 0
        while not job.is_finished:
            self.step()
            if job.executed_count > reported:
                reported = job.executed_count
                on_reported(job)
            if self._clock.now_s() > until_s:
                raise LinkError(f"{self.session.port}: a point was not reported within {POINT_TIMEOUT_S:g} s")
        return job


def find_weakest_pixel(display: DisplayModel) -> int:
    """Return the pixel with the highest steady temperature rise per watt."""
    heat = display.budget.heat
    return int(np.argmax(heat.epsilon * heat.r_k_per_w))


def max_settling_s(config: Config) -> float:
    """Return the gate-off time in which any move settles, s, rounded up to milliseconds."""
    scanner = config.scanner
    ramp_s = 2.0 * scanner.range_rad / scanner.slew_rad_per_s
    constant_s = 1.0 / (2.0 * pi * scanner.bandwidth_hz * scanner.damping)
    return ceil(1e3 * (scanner.delay_s + ramp_s + SETTLING_TIME_CONSTANTS * constant_s)) * 1e-3


def spot_width_s(config: Config) -> float:
    """Return the width of a spot's pulse, s: whole PWM periods within the configured maximum."""
    pwm_hz = config.laser.pwm_hz
    periods = max(1, int(min(SPOT_WIDTH_S, config.limits.pulse_width_max_s) * pwm_hz * (1 + 1e-9)))
    return round(periods / pwm_hz * 1e6) * 1e-6


def max_spot_power_w(config: Config) -> float:
    """Return the maximum power of a spot, W."""
    return min(SPOT_POWER_MAX_W, SPOT_SHARE_MAX * config.laser.max_power_w)


def check_spot_power(config: Config, power_w: float, option: str = "--spot-power-mw") -> None:
    """Raise InputError, naming the option, for a power outside the range of a spot."""
    max_w = max_spot_power_w(config)
    if not 0.0 < power_w <= max_w:
        raise InputError(
            option, Unquoted(f"{power_w * 1e3:g} mW"), f"more than 0 and at most {format_number(max_w * 1e3)} mW"
        )
