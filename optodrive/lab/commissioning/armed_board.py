"""A board that one task arms, keeps armed and disarms.

`close` sends ABORT. If the board does not receive it, the closed port and the lease turn the gate off.
"""

import sys
from collections.abc import Callable
from typing import Self

from optodrive.core.clock import Clock
from optodrive.core.errors import BoardFaultError, LinkError, NotReadyError
from optodrive.core.garbage import settle_memory
from optodrive.core.scheduling import LIGHT, set_realtime_priority
from optodrive.device.config import Config
from optodrive.link.board_setup import build_bench_requirements
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.link.protocol.states import BoardState
from optodrive.link.session.fault_hints import get_fault_hint
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.base import Transport

LOOP_STEP_S = 0.002
SWITCH_INTERVAL_S = 2e-4
"""As in the engine: a computing thread must not delay the lease."""
FIELD_MARGIN_M = 4e-3
"""Permitted margin beyond the outermost pixels; the error of an uncorrected beam is smaller."""
ARM_TIMEOUT_S = 4.0
STATUS_TIMEOUT_S = 2.0
POINT_TIMEOUT_S = 3.0
FAULT_NAME_TIMEOUT_S = 0.5


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
