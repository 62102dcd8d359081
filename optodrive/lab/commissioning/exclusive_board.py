"""Exclusive access to a board for one task: it is armed once and executes points and plans that the limiter has passed.

Points are limited as those of the daemon are: accounted to one timeline of heat, encoded, decoded and proven again. A
point whose pixel is unknown counts for the one that it would heat most. The timeline begins with the heat that the
display's record states, and the record gets what is left of it at the end.
"""

from collections.abc import Callable
from math import inf

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import BoardFaultError, InputError, LocalProtocolError, OverBudgetError
from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan, PulsePlan
from optodrive.device.config import Config, build_pixel_layout
from optodrive.lab.commissioning.armed_board import FIELD_MARGIN_M, LOOP_STEP_S, ArmedBoard, ignore_reports
from optodrive.lab.commissioning.spot_bounds import check_spot_power, max_settling_s, spot_width_s
from optodrive.link.protocol.quantisation import CENTRE_CODE, DUTY_MAX, WirePoints, decode, quantise
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.transport.base import Transport
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.heat_record import BOARDS, HeatRecord, join_uids
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import limit, shift_state, verify

HALF_TRAVEL_MIN_M = 3e-3
"""Shortest way of a mirror from the centre that shows its travel; a smaller display is left by as much."""
START_LEAD_S = 0.03


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
        self._settling_s, self._width_s = max_settling_s(config), spot_width_s(config)
        # The mirrors leave for a single point when it begins, which is earlier than the lead-in of a plan.
        leaving_s = np.full_like(display.budget.galvos.lead_in_s, self._settling_s)
        self._point_budget = display.budget._replace(galvos=display.budget.galvos._replace(lead_in_s=leaving_s))

    @property
    def config(self) -> Config:
        """Configuration of the display."""
        return self.display.config

    def connect(self) -> None:
        """Load the kernels first, because compilation would delay the lease, then connect."""
        limit(self._plan(0.0, 0.0, self.zero_duty_power_w), self._state, self.display.budget)
        super().connect()
        if self._record is None:
            self._recall_heat()

    def _recall_heat(self) -> None:
        """Take the display as warm as its record states, once its last pulse is over."""

        def keep_link() -> None:
            self.session.step(LOOP_STEP_S, renew_lease=False)

        identity = join_uids([self.session.board.uid], self._is_part)
        record = HeatRecord(BOARDS, identity, self.display, self._clock, keep_link).open()
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
        x_rad, y_rad = self.session.scale.to_angles_rad(np.array([x_code, y_code]))
        self._emit(self._plan(x_rad, y_rad, power_w), self._point_budget, gate_on)

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
        executed = job.build_executed(limited, self.session.scale.full_power_w, self.session.scale.tick_s)
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
