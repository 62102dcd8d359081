"""Exclusive access to a board for one task: it is armed once and executes points and plans that the limiter has passed.

`ArmedBoard` arms a board, keeps it armed and disarms it. `close` sends ABORT. If the board does not receive it, the
closed port and the lease turn the gate off.

Points are limited as those of the daemon are: accounted to one timeline of heat, encoded, decoded and proven again. A
point whose pixel is unknown counts for the one that it would heat most. The timeline begins with the heat that the
display's record states, and the record gets what is left of it at the end.
"""

import sys
from collections.abc import Callable
from math import ceil, inf, pi
from typing import NamedTuple, Self

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
from optodrive.core.processes import LIGHT, set_realtime_priority, settle_memory
from optodrive.core.quantity import format_number, format_quantity
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan, PulsePlan
from optodrive.device.config import Config, build_pixel_layout
from optodrive.link.board_setup import build_bench_requirements
from optodrive.link.protocol.quantisation import CENTRE_CODE, WirePoints, decode, quantise
from optodrive.link.protocol.states import BoardState
from optodrive.link.session.board_view import get_fault_hint
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.base import Transport
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.heat_record import HeatRecord, identify_display
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import limit, shift_state, verify

LOOP_STEP_S = 0.002
SWITCH_INTERVAL_S = 2e-4
"""As in the engine: a computing thread must not delay the lease."""
FIELD_MARGIN_M = 4e-3
"""Permitted margin beyond the outermost pixels; the error of an uncorrected beam is smaller."""
ARM_TIMEOUT_S = 4.0
STATUS_TIMEOUT_S = 2.0
POINT_TIMEOUT_S = 3.0
FAULT_NAME_TIMEOUT_S = 0.5
SPOT_POWER_MAX_W = 0.05
"""Maximum power of a spot: 2 % of a pixel's drive power; steady on one absorber it adds a few kelvin."""
SPOT_SHARE_MAX = 0.05
"""Maximum power of a spot relative to the laser's power."""
SPOT_WIDTH_S = 0.02
SETTLING_TIME_CONSTANTS = 15.0
"""Settling time after a move in time constants of the servo."""
HALF_TRAVEL_MIN_M = 3e-3
"""Shortest way of a mirror from the centre that shows its travel; a smaller display is left by as much."""
START_LEAD_S = 0.03


def ignore_reports(job: PlanJob) -> None:
    """Do nothing with the reports of a job."""


class ArmedBoard:
    """A board, its session and its lease.

    Methods raise LinkError, BoardFaultError or NotReadyError when the task must end.
    """

    def __init__(self, config: Config, transport: Transport, clock: Clock) -> None:
        self.requirements = build_bench_requirements(config, FIELD_MARGIN_M)
        self.session = BoardSession(transport, clock, self.requirements)
        self._clock = clock
        self._arm_requested = self._armed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def connect(self) -> None:
        """Open the link and begin a session with the lease's priority."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        set_realtime_priority(LIGHT)
        settle_memory()
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

    def _require_ready(self) -> None:
        """Wait until a job may start. Raise NotReadyError if the board is not armed."""
        if not self._armed:
            raise NotReadyError(f"the board is not armed: {self.session.board.state}")
        until_s = self._clock.now_s() + POINT_TIMEOUT_S
        while not self.session.is_ready:
            self.step()
            if self._clock.now_s() > until_s:
                raise LinkError(f"{self.session.port}: the board was not ready within {POINT_TIMEOUT_S:g} s")

    def _run_job(
        self, points: WirePoints, start_s: float, on_reported: Callable[[PlanJob], None] = ignore_reports
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


def max_settling_s(config: Config) -> float:
    """Return the gate-off time in which any move settles, s, rounded up to milliseconds."""
    scanner = config.scanner
    ramp_s = 2.0 * scanner.range_rad / scanner.slew_rad_per_s
    constant_s = 1.0 / (2.0 * pi * scanner.bandwidth_hz * scanner.damping)
    return ceil(1e3 * (scanner.delay_s + ramp_s + SETTLING_TIME_CONSTANTS * constant_s)) * 1e-3


def spot_width_s(config: Config) -> float:
    """Return the width of a spot's pulse, s: whole PWM periods within the configured maximum."""
    return _round_width_s(config, min(SPOT_WIDTH_S, config.limits.pulse_width_max_s))


def _round_width_s(config: Config, width_s: float) -> float:
    """Return the next smaller width of a pulse, s, but at least one step."""
    steps_hz = config.laser.width_steps_hz
    return round(max(1, int(width_s * steps_hz * (1 + 1e-9))) / steps_hz * 1e6) * 1e-6


class Spot(NamedTuple):
    """The pulse of a spot: power, W, and width, s."""

    power_w: float
    width_s: float


def build_spot(config: Config, power_w: float) -> Spot:
    """Return the spot of a power, W.

    A laser that emits no power as weak as this gets the energy by a shorter pulse of its weakest.
    """
    width_s, weakest_w = spot_width_s(config), config.min_power_w
    if power_w >= weakest_w:
        return Spot(power_w, width_s)
    return Spot(weakest_w, _round_width_s(config, power_w / weakest_w * width_s))


def max_spot_power_w(config: Config) -> float:
    """Return the maximum power of a spot, W."""
    return min(SPOT_POWER_MAX_W, SPOT_SHARE_MAX * config.laser.max_power_w)


def check_spot_power(config: Config, power_w: float, option: str = "--spot-power-mw") -> None:
    """Raise InputError, naming the option, for a power outside the range of a spot."""
    max_w = max_spot_power_w(config)
    shortest_w = config.min_power_w / config.laser.width_steps_hz / spot_width_s(config)
    if 0.0 < power_w < shortest_w:
        expected = f"at least {format_number(shortest_w * 1e3)} mW, that of the laser's weakest and shortest pulse"
        raise InputError(option, Unquoted(f"{power_w * 1e3:g} mW"), expected)
    if not 0.0 < power_w <= max_w:
        raise InputError(
            option, Unquoted(f"{power_w * 1e3:g} mW"), f"more than 0 and at most {format_number(max_w * 1e3)} mW"
        )


class ExclusiveBoard(ArmedBoard):
    """A board that executes only points and plans that fit all caps of its display.

    display: that the limiter computes with; is_part: whether other boards draw on the same display
    on_warm: called with one sentence if the display counts as hot, or as not yet cooled from that
    """

    def __init__(
        self,
        display: DisplayModel,
        transport: Transport,
        clock: Clock,
        is_part: bool = False,
        on_warm: Callable[[str], None] = lambda text: None,
    ) -> None:
        config = display.config
        super().__init__(config, transport, clock)
        self.display = display
        self._state = display.build_cold_state()[1]
        self._timeline_zero_s: float | None = None
        self._is_part, self._on_warm = is_part, on_warm
        self._record: HeatRecord | None = None
        self._is_interrupted, self._is_known = False, True
        self._accounted_pixel = find_weakest_pixel(display)
        self._settling_s = max_settling_s(config)
        # The mirrors leave for a single point when it begins, which is earlier than the lead-in of a plan.
        leaving_s = np.full_like(display.budget.galvos.lead_in_s, self._settling_s)
        self._point_budget = display.budget._replace(galvos=display.budget.galvos._replace(lead_in_s=leaving_s))

    @property
    def config(self) -> Config:
        """Configuration of the display."""
        return self.display.config

    def connect(self) -> None:
        """Load the kernels first, because compilation would delay the lease, then connect."""
        limit(self._plan(0.0, 0.0, self._gate_off), self._state, self.display.budget)
        super().connect()
        if self._record is None:
            self._recall_heat()

    def _recall_heat(self) -> None:
        """Take the display as warm as its record states, once its last pulse is over."""

        def keep_link() -> None:
            self.session.step(LOOP_STEP_S, renew_lease=False)

        kind, identity = identify_display(self.config, [self.session.board.uid], self._is_part)
        record = HeatRecord(kind, identity, self.display, self._clock, keep_link).open()
        self._state, self._record = record.load(), record
        self._timeline_zero_s = self.session.board_s()
        if record.read_cooling()[1]:
            self._on_warm(f"the display counts as {record.describe()}")
        while self.session.board_s() < self._timeline_zero_s + self._state.at_s:
            keep_link()

    def arm(self) -> float:
        """Record that the display is in use, then arm. Raise InputError, and arm nothing, if that is impossible."""
        if self._record is not None:
            self._record.begin_use()
        return super().arm()

    def close(self) -> None:
        """Send ABORT, close the link, and record the heat."""
        try:
            super().close()
        finally:
            record, self._record = self._record, None
            if record is not None and self._timeline_zero_s is not None:
                age_s = self.session.board_s() - self._timeline_zero_s
                if self._is_interrupted:  # it counts as if all of it came now: when it came is not known
                    age_s = min(age_s, -self.config.lease_s)
                if self._is_known:
                    record.save(self._state, age_s)
                record.close()

    def move_to(self, x_code: int, y_code: int) -> None:
        """Move the mirrors with the gate off and wait until they have settled."""
        self._execute_point(x_code, y_code, self._gate_off, gate_on=False)

    def fire_spot(self, x_code: int, y_code: int, power_w: float) -> None:
        """Emit one short pulse with settled mirrors and wait until the board has reported it in full."""
        check_spot_power(self.config, power_w)
        self._execute_point(x_code, y_code, build_spot(self.config, power_w), gate_on=True)

    def play(self, plan: PulsePlan, on_reported: Callable[[PlanJob], None]) -> None:
        """Play a plan once it fits all caps without trimming, and wait until the board has reported it in full.

        on_reported: called with the job when further pulses are reported; it must not block. Raises OverBudgetError if
        the plan never fits, and BoardFaultError if the board kept the gate on for another time than planned.
        """
        self._emit(plan, self.display.budget, gate_on=True, on_reported=on_reported)

    def play_gate_off(self, plan: PulsePlan, points: WirePoints) -> IntArray:
        """Play points that never turn the gate on, and return the board tick at the end of each point, [n].

        plan: the mirrors' moves as pulses of no power, for the limiter; points: the same moves on the wire, each with a
        row of its own. Raises LocalProtocolError, before anything is sent, if a point would turn the gate on, and
        OverBudgetError if the moves never fit the galvo cap.
        """
        self._require_ready()
        *_, start_s = self._account(plan, self.display.budget, 0, points)
        job = self._run_job(points, start_s)
        end_tick: IntArray = job.read_reported(0, len(points)).on_tick
        planned_end = job.start_tick + points.compute_end_ticks()
        self._timeline_zero_s = start_s + max(0.0, float(end_tick[-1] - planned_end[-1]) * self.session.scale.tick_s)
        return end_tick

    @property
    def zero_duty_power_w(self) -> float:
        """Power that rounds to duty 0: the gate stays off, while the limiter still counts the move."""
        return 0.5 * self.config.min_power_w

    @property
    def _gate_off(self) -> Spot:
        return Spot(self.zero_duty_power_w, spot_width_s(self.config))

    def _plan(self, x_rad: float, y_rad: float, spot: Spot) -> PulsePlan:
        """Build a plan of one pulse, accounted to the weakest pixel because the pixel it hits is unknown."""
        return PulsePlan(
            start_s=np.array([self._settling_s]),
            width_s=np.array([spot.width_s]),
            x_rad=np.array([x_rad]),
            y_rad=np.array([y_rad]),
            power_w=np.array([spot.power_w]),
            pixel=np.array([self._accounted_pixel]),
            settling_s=np.array([self._settling_s]),
            target_m=np.array([np.nan]),
            requested_start_s=np.array([self._settling_s]),
            source=np.array([0]),
            stage=np.array([0]),
        )

    def _execute_point(self, x_code: int, y_code: int, spot: Spot, gate_on: bool) -> None:
        self.check_range(x_code, y_code)
        x_rad, y_rad = self.session.scale.to_angles_rad(np.array([x_code, y_code]))
        self._emit(self._plan(x_rad, y_rad, spot), self._point_budget, gate_on)

    def check_range(self, x_code: int, y_code: int) -> None:
        """Raise InputError for codes beyond the display and its margin."""
        for axis, code, low, high in zip("xy", (x_code, y_code), *self._code_limits, strict=True):
            if not low <= code <= high:
                raise InputError(
                    f"{axis}_code",
                    code,
                    f"{low:g} to {high:g}, the display and {format_quantity(FIELD_MARGIN_M, 'm')} more",
                )

    @property
    def half_travel_codes(self) -> tuple[int, int]:
        """Way of mirrors x and y from the centre to either side that spans the display, within the board's range."""
        layout, scanner = build_pixel_layout(self.config.display), self.config.scanner
        code_m = 2.0 * scanner.focal_length_m * scanner.rad_per_code
        x_codes, y_codes = (
            round(max(float(np.abs(axis_m).max()), HALF_TRAVEL_MIN_M) / code_m) for axis_m in (layout.x_m, layout.y_m)
        )
        room = np.abs(self._code_limits - CENTRE_CODE).min(axis=0).tolist()
        return min(x_codes, room[0]), min(y_codes, room[1])

    def clip_codes(self, codes: FloatArray) -> FloatArray:
        """Clip codes [k, 2] to the board's range."""
        return np.clip(codes, *self._code_limits)

    @property
    def _code_limits(self) -> IntArray:
        """Lowest and highest codes of the board's range along x and y, [2, 2]."""
        limits = self.requirements.limits
        outputs = np.array([limits.x_min, limits.x_max]), np.array([limits.y_min, limits.y_max])
        return np.sort(np.column_stack(self.session.scale.to_axes(*outputs)), axis=0)

    def _account(
        self, plan: PulsePlan, budget: Budget, pulses: int, points: WirePoints | None = None
    ) -> tuple[LimitedPlan, WirePoints, float]:
        """Wait until the limiter passes a plan, verify its encoded points, and account for it.

        pulses: number of points with the gate on; points: the plan on the wire, unless its own. Returns plan and points
        as they may be sent, and the start, s.
        """
        while True:
            start_s = self.session.board_s() + START_LEAD_S
            zero_s = start_s if self._timeline_zero_s is None else self._timeline_zero_s
            before = shift_state(self._state, zero_s - start_s)
            try:
                limited, after = limit(plan, before, budget, "refuse")
                break
            except OverBudgetError as error:
                if error.fits_after_s == inf:
                    raise
                self.wait(error.fits_after_s)
        points = quantise(limited, self.session.scale) if points is None else points
        self._verify_encoded(points, limited, before, pulses, budget)
        self._state, self._timeline_zero_s = after, start_s
        return limited, points, start_s

    def _verify_encoded(
        self, points: WirePoints, plan: LimitedPlan, before: BudgetState, pulses: int, budget: Budget
    ) -> None:
        """Decode the encoded points and verify them against the budget."""
        decoded = decode(points.encode_payload(), self.session.scale)
        if len(decoded.index) != pulses:
            raise LocalProtocolError(f"{len(decoded.index)} points with the gate on, expected {pulses}")
        verify(plan, points.row[decoded.index], decoded, before, budget)

    def _emit(
        self,
        plan: PulsePlan,
        budget: Budget,
        gate_on: bool,
        on_reported: Callable[[PlanJob], None] = ignore_reports,
    ) -> None:
        """Send a plan once it fits all caps, and wait for its reports.

        Their delay shifts what follows.
        """
        self._require_ready()
        limited, points, start_s = self._account(plan, budget, len(plan) if gate_on else 0)
        self._is_interrupted = True  # until its delay is accounted for
        job = self._run_job(points, start_s, on_reported)
        executed = job.build_executed(limited, self.session.scale)
        if gate_on and not np.allclose(executed.width_s, limited.width_s):
            self._is_known = False
            raise BoardFaultError(
                f"the board kept the gate on for {executed.width_s.sum():g} s; expected {limited.width_s.sum():g} s"
            )
        ended_s = float(executed.start_s[-1] + executed.width_s[-1])
        self._timeline_zero_s = start_s + max(0.0, ended_s - float(limited.start_s[-1] + limited.width_s[-1]))
        self._is_interrupted = False


def find_weakest_pixel(display: DisplayModel) -> int:
    """Return the pixel with the highest steady temperature rise per watt."""
    heat = display.budget.heat
    return int(np.argmax(heat.epsilon * heat.r_k_per_w))
