"""The simulated board's state machine: arming, points and guards in virtual time, without the link.

It enforces B1 to B11 and B17 of PROTOCOL.md. Time is whole microseconds and advances only when the caller says so;
each due event is carried out, and logged, at its exact time.
"""

from collections import deque
from collections.abc import Callable, Iterable
from random import Random
from typing import Any

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.states import (
    ARMED_STATES,
    IDLE_STATES,
    LEASED_STATES,
    BoardState,
    EventReason,
    find_transition,
)
from optodrive.link.simulator.guards import BoardSettings, EmissionGuards, tighten
from optodrive.link.simulator.point_queue import BoardJob, ExecutionRecord, ExecutionRecords, PointQueue, QueuedPoint

INDICATOR_US = 2_000_000
ARMING_TIMEOUT_US = 10_000_000
HOLD_MAX_US = 1_000_000
UNDERRUNS_MAX = 3
UNDERRUN_WINDOW_US = 10_000_000
INDEX_MAX = 0xFFFF_FFFF
WATCH_US = 500
"""Time between two measurements of the mirrors."""
CENTRE_CODE = 32768
SAFE_INPUTS = {"interlock": True, "key": True, "estop": False}
INPUT_FAULTS = {"interlock": "INTERLOCK", "key": "KEY", "estop": "ESTOP"}

LogSink = Callable[[dict[str, Any]], None]
"""Receives each log event, with its time t_us."""
MirrorSink = Callable[[int, int, int], None]
"""Receives each move of the mirrors: target codes of x and y, and the time in µs."""
MirrorReader = Callable[[int], tuple[float, float]]
"""Returns the measured codes of x and y at a time in µs."""
EventSink = Callable[[m.Event], None]
"""Receives the EVENT of each change of state."""


class BoardMachine:
    """A board from power-up on. Methods that carry out a message return its NAK reason, or '' if it is accepted."""

    def __init__(
        self,
        settings: BoardSettings,
        rng: Random,
        log_sink: LogSink,
        mirror_sink: MirrorSink,
        mirror_reader: MirrorReader,
        event_sink: EventSink,
    ) -> None:
        self._settings = settings
        self._random = rng
        self._log_sink, self._mirror_sink, self._event_sink = log_sink, mirror_sink, event_sink
        self._read_mirrors, self._feedback_codes = mirror_reader, settings.feedback_codes
        self.now_us = 0
        self.inputs = dict(SAFE_INPUTS)
        self.gate = False
        self.state, self.fault = BoardState.BOOT, ""

    def power_up(self) -> None:
        """Start from BOOT with nothing remembered but the inputs and the time."""
        self.epoch_us = self.now_us
        self.state, self.fault = BoardState.BOOT, ""
        self.limits = self._settings.limits
        self.queue = PointQueue()
        self.records = ExecutionRecords()
        self.lease_until_us = 0
        self.laser_on_duty_us = 0
        self.underruns_total = 0
        self._guards = EmissionGuards(self._settings.cell_codes, self._settings.cells, self._settings.window_pulses)
        self._position = (CENTRE_CODE, CENTRE_CODE)
        self._mirror_sink(*self._position, self.now_us)
        self._follows = not self._feedback_codes
        self._settled_us = self.now_us + (0 if self._follows else self._compute_settling_us(CENTRE_CODE))
        self._watched_us = self.now_us
        self.measured_codes = 0, 0
        self._current_point: QueuedPoint | None = None
        self._gate_on_us = self._due_us = 0
        self._board_nonce: int | None = None
        self._host_nonce: int | None = None
        self._arming_since_us = 0
        self._confirmed = False
        self._hold_since_us = 0
        self._underrun_times_us: deque[int] = deque()
        self._key_turned = False
        self.triggers, self.trigger_tick = 0, 0
        self._is_version_supported = False
        self._change_state(EventReason.BOOT)

    def power_down(self) -> None:
        """Close the gate as a loss of power does: the point it lights leaves no record."""
        self._set_gate(False, "reset")
        self._current_point = None

    @property
    def current_tick(self) -> int:
        """Ticks since power-up."""
        return self.now_us - self.epoch_us

    @property
    def duty(self) -> int:
        """Duty of the present light, 0 with the gate off."""
        return self._current_point.duty if self.gate and self._current_point is not None else 0

    # --- time ---------------------------------------------------------------------------------------------------

    def next_event_us(self) -> int | None:
        """Return the time of the next due event, None if there is none."""
        due = [self._point_due_us(), self._lease_due_us(), self._arming_due_us(), self._hold_due_us()]
        due.append(self._watch_due_us())
        return min((at_us for at_us in due if at_us is not None), default=None)

    def advance(self, now_us: int) -> None:
        """Carry out each event due up to now_us, in order and at its exact time."""
        while True:
            due_us = self.next_event_us()
            if due_us is None or due_us > now_us:
                break
            self.now_us = max(self.now_us, due_us)
            self._run_due_event()
        self.now_us = max(self.now_us, now_us)

    def _run_due_event(self) -> None:
        if self._is_due(self._lease_due_us()):
            self._enter_fault("LINK")
        elif self._is_due(self._arming_due_us()):
            self._finish_arming()
        elif self._is_due(self._hold_due_us()):
            self.disarm(EventReason.HOLD_TOO_LONG)
        elif self._is_due(self._watch_due_us()):
            self._watch_mirrors()
        else:
            self._advance_point()

    def _is_due(self, due_us: int | None) -> bool:
        return due_us is not None and due_us <= self.now_us

    def _lease_due_us(self) -> int | None:
        return self.lease_until_us if self.state in LEASED_STATES else None

    def _arming_due_us(self) -> int | None:
        if self.state != BoardState.ARMING:
            return None
        return self._arming_since_us + (INDICATOR_US if self._confirmed else ARMING_TIMEOUT_US)

    def _hold_due_us(self) -> int | None:
        if self.state == BoardState.HOLD:
            return self._hold_since_us + HOLD_MAX_US
        job = self.queue.job
        if self.state != BoardState.RUNNING or self._current_point is not None or job is None:
            return None
        if job.trigger_delay_us is not None:
            return job.expires_us
        return None if self.queue.has_enough_points else job.start_us + HOLD_MAX_US

    def _watch_due_us(self) -> int | None:
        return self._watched_us + WATCH_US if self._feedback_codes else None

    def _point_due_us(self) -> int | None:
        if self.state != BoardState.RUNNING:
            return None
        if self._current_point is not None:
            return self._due_us
        job = self.queue.job
        if job is None or job.trigger_delay_us is not None or not self.queue.has_enough_points:
            return None
        return max(job.start_us, self.now_us)

    # --- mirrors ------------------------------------------------------------------------------------------------

    def _compute_settling_us(self, codes: int) -> int:
        return self.limits.settle_us + -(-codes * self.limits.settle_ns_per_code // 1000)

    def _measure_mirrors(self) -> bool:
        """Return whether both mirrors follow their command. While a move settles, the last answer stands."""
        if not self._feedback_codes:
            return True
        measured = self._read_mirrors(self.now_us)
        if self.now_us >= self._settled_us:
            away = max(abs(code - at) for code, at in zip(measured, self._position, strict=True))
            self._follows = away <= self._feedback_codes
        self.measured_codes = clip_code(measured[0]), clip_code(measured[1])
        return self._follows

    def _watch_mirrors(self) -> None:
        self._watched_us = self.now_us
        followed = self._follows
        if not self._measure_mirrors() and followed:
            self._enter_fault("SCAN")

    # --- points -------------------------------------------------------------------------------------------------

    def _advance_point(self) -> None:
        """Carry out the next phase: begin a point, open the gate, or finish the point."""
        point = self._current_point
        if point is None:
            self._begin_point(self.queue.pop())
        elif not self.gate and point.on_us:
            self._begin_pulse(point)
        else:
            self._finish_point(point)

    def _begin_point(self, point: QueuedPoint) -> None:
        move = max(abs(point.x - self._position[0]), abs(point.y - self._position[1]))
        if move:
            # An interrupted move may have left the mirrors anywhere on its path: its own settling time counts too.
            self._settled_us = max(self._settled_us, self.now_us) + self._compute_settling_us(move)
        self._position = point.x, point.y
        self._mirror_sink(point.x, point.y, self.now_us)
        self._current_point = point
        self._due_us = max(self.now_us + point.dark_us, self._settled_us)

    def _begin_pulse(self, point: QueuedPoint) -> None:
        if not self._measure_mirrors():
            self._enter_fault("SCAN")
            return
        fault = self._guards.check_pulse(self.limits, point.x, point.y, self.now_us, point.on_us, point.duty)
        if fault:
            self._enter_fault(fault)
            return
        self._guards.record_pulse(self.limits, point.x, point.y, self.now_us, point.on_us, point.duty)
        self._gate_on_us = self.now_us
        self._due_us = self.now_us + point.on_us
        self._set_gate(True, f"point {point.number}")

    def _finish_point(self, point: QueuedPoint) -> None:
        if self.gate:
            self._set_gate(False, f"point {point.number} done")
            self._record_execution(point, self._gate_on_us, point.on_us)
        else:
            self._record_execution(point, self.now_us, 0)
        self._current_point = None
        if self.queue.is_job_done:
            self._finish_job()
        elif self.queue:
            self._begin_point(self.queue.pop())
        else:
            self._on_underrun()

    def _record_execution(self, point: QueuedPoint, on_at_us: int, on_us: int) -> None:
        self.queue.done_index = point.number + 1
        self.laser_on_duty_us += on_us * point.duty
        self.records.add(ExecutionRecord(point.number, on_at_us - self.epoch_us, on_us, point.duty if on_us else 0))
        if on_us:
            self._log(
                "pulse",
                index=point.number,
                x=point.x,
                y=point.y,
                duty=point.duty,
                on_us=on_at_us,
                off_us=on_at_us + on_us,
            )

    def _finish_job(self) -> None:
        self.queue.job = None
        self._change_state(EventReason.JOB_DONE)

    def _on_underrun(self) -> None:
        self.underruns_total += 1
        self._underrun_times_us.append(self.now_us)
        while self._underrun_times_us[0] < self.now_us - UNDERRUN_WINDOW_US:
            self._underrun_times_us.popleft()
        if len(self._underrun_times_us) >= UNDERRUNS_MAX:
            self._enter_fault("UNDERRUN")
            return
        self._hold_since_us = self.now_us
        self._change_state(EventReason.QUEUE_EMPTY)

    def _resume_if_refilled(self) -> None:
        if self.state == BoardState.HOLD and self.queue.has_enough_points:
            self._change_state(EventReason.REFILLED)

    # --- states -------------------------------------------------------------------------------------------------

    def _set_gate(self, on: bool, reason: str) -> None:
        if on != self.gate:
            self.gate = on
            self._log("gate", on=on, reason=reason)

    def _change_state(self, event: EventReason) -> None:
        """Change to the state that the event leads to, and report it. Only RUNNING leaves the gate as it is."""
        state, drops = find_transition(self.state, event)
        if state != BoardState.RUNNING:
            self._close_gate(event)
        previous, self.state = self.state, state
        self._log("state", state=state, before=previous, reason=event)
        fault = m.FAULTS.index(self.fault)
        self._event_sink(m.Event(m.STATES.index(state), fault, m.EVENT_REASONS.index(event), self.current_tick))
        if drops:
            self.queue.drop()

    def _close_gate(self, reason: str) -> None:
        """Close the gate and record the emission of an interrupted pulse."""
        point, gate_was_on = self._current_point, self.gate
        self._set_gate(False, reason)
        if point is not None and gate_was_on:
            self._record_execution(point, self._gate_on_us, self.now_us - self._gate_on_us)
        self._current_point = None

    def disarm(self, event: EventReason) -> None:
        """Drop the queue and leave any armed state. DISARMED and FAULT stay."""
        self._confirmed = False
        self._board_nonce = None
        if self.state in IDLE_STATES:
            self.queue.drop()
        else:
            self._change_state(event)

    def _enter_fault(self, fault: str) -> None:
        if self.state != BoardState.FAULT:
            self.fault = fault
            self._log("fault", fault=fault)
            self._change_state(EventReason.FAULT)
        self._confirmed = False
        self._board_nonce = None

    @property
    def _is_safe(self) -> bool:
        return self.inputs == SAFE_INPUTS and self._follows

    def fail(self, fault: str) -> None:
        """Enter FAULT by a cause that lies behind the outputs."""
        self._enter_fault(fault)

    def set_input(self, name: str, value: bool) -> None:
        """Change an input: interlock (True: closed), key (True: on), estop (True: pressed)."""
        if name == "key" and value and not self.inputs["key"]:
            self._key_turned = True
        self.inputs[name] = value
        self._log("input", input=name, value=value)
        if value != SAFE_INPUTS[name]:
            self._enter_fault(INPUT_FAULTS[name])

    def receive_trigger(self) -> None:
        """Count a rising edge at the trigger input, and start the job that awaits one."""
        self.triggers, self.trigger_tick = self.triggers + 1, self.current_tick
        job = self.queue.job
        if job is not None and job.trigger_delay_us is not None:
            job.start_us, job.trigger_delay_us = self.now_us + job.trigger_delay_us, None
        self._log("trigger", count=self.triggers)

    def clear_fault(self) -> str:
        """Acknowledge a fault and forget the underruns."""
        if self.state != BoardState.FAULT:
            return "STATE"
        if not self._is_safe:
            return "INPUT"
        self.fault = ""
        self._underrun_times_us.clear()
        self._change_state(EventReason.FAULT_CLEARED)
        return ""

    # --- session and arming -------------------------------------------------------------------------------------

    def begin_session(self, is_version_supported: bool) -> None:
        """Restore the board's own limits and forget all indices and records."""
        self.limits = self._settings.limits
        self.queue.reset_indices()
        self.records.clear()
        self._is_version_supported = is_version_supported

    def renew_lease(self, duration_ms: int) -> None:
        """Extend the lease up to the board's own maximum from now. It never shortens."""
        if self.state in LEASED_STATES:
            until_us = self.now_us + 1000 * min(duration_ms, self.limits.lease_ms)
            self.lease_until_us = max(self.lease_until_us, until_us)

    def tighten_limits(self, requested: m.Limits) -> str:
        """Apply each requested limit that is tighter than the present one."""
        if self.state not in IDLE_STATES:
            return "STATE"
        self.limits = tighten(self.limits, requested)
        return ""

    def request_arming(self, host_nonce: int) -> str:
        """Enter ARMING. `challenge` then holds the nonces to confirm."""
        if self.state != BoardState.DISARMED:
            return "STATE"
        if not self._is_version_supported:
            return "VERSION"
        if not self._is_safe:
            return "INPUT"
        if self._settings.key_edge and not self._key_turned:
            return "KEY_EDGE"
        self._board_nonce = self._random.getrandbits(32)
        self._host_nonce = host_nonce
        self._arming_since_us = self.now_us
        self._confirmed = False
        self.lease_until_us = self.now_us + 1000 * self.limits.lease_ms
        self._change_state(EventReason.ARM_REQUESTED)
        return ""

    @property
    def challenge(self) -> tuple[int, int] | None:
        """Nonces of host and board that ARM_CONFIRM must repeat, None if no confirmation is expected."""
        if self._host_nonce is None or self._board_nonce is None:
            return None
        return self._host_nonce, self._board_nonce

    def confirm_arming(self, host_nonce: int, board_nonce: int) -> str:
        """Confirm the challenge. A challenge is valid for one attempt, right or wrong."""
        challenge, self._board_nonce = self.challenge, None
        if self.state != BoardState.ARMING or self._confirmed:
            return "STATE"
        if challenge != (host_nonce, board_nonce):
            self.disarm(EventReason.DISARM)
            return "NONCE"
        self._confirmed = True
        self._key_turned = False
        return ""

    def _finish_arming(self) -> None:
        if self._confirmed:
            self._change_state(EventReason.ARMED)
        else:
            self.disarm(EventReason.ARMING_TIMED_OUT)

    # --- jobs ---------------------------------------------------------------------------------------------------

    def queue_points(self, first_index: int, values: Iterable[tuple[int, int, int, int, int]]) -> str:
        """Queue points numbered from first_index on: all of them, or none."""
        queue = self.queue
        if self.state not in ARMED_STATES:
            return "STATE"
        if first_index < queue.next_index or (first_index > queue.next_index and not queue.is_idle):
            return "INDEX"
        points = [QueuedPoint(first_index + k, *each) for k, each in enumerate(values)]
        if first_index + len(points) > INDEX_MAX:
            return "INDEX"
        if len(queue) + len(points) > self._settings.queue_points:
            return "NO_ROOM"
        for point in points:
            fault = self._check_point(point)
            if fault:
                self._enter_fault(fault)
                return "STATE"
        queue.append(points)
        self._resume_if_refilled()
        return ""

    def _check_point(self, point: QueuedPoint) -> str:
        """Return the fault that queueing the point causes, '' if there is none."""
        limits = self.limits
        if not (limits.x_min <= point.x <= limits.x_max and limits.y_min <= point.y <= limits.y_max):
            return "RANGE"
        if point.on_us > limits.max_on_us:
            return "ON_TIME"
        if point.duty > limits.max_duty:
            return "DUTY"
        return ""

    def start_job(self, message: m.Start) -> str:
        """Start a job at its tick, or at once if that is past."""
        if self.state != BoardState.ARMED:
            return "STATE"
        if message.first_index != self.queue.first_index:
            return "INDEX"
        start_us = max(self.epoch_us + message.start_tick, self.now_us)
        self.queue.job = BoardJob(message.job, start_us, message.watermark)
        self._change_state(EventReason.START)
        return ""

    def start_job_on_trigger(self, message: m.StartOnTrigger) -> str:
        """Let a job start at the next trigger."""
        if self.state != BoardState.ARMED:
            return "STATE"
        if message.first_index != self.queue.first_index or not self.queue:
            return "INDEX"
        expires_us = self.now_us + 1000 * message.wait_ms
        self.queue.job = BoardJob(
            message.job, self.now_us, watermark=1, trigger_delay_us=message.delay_us, expires_us=expires_us
        )
        self._change_state(EventReason.START)
        return ""

    def end_job(self, message: m.End) -> str:
        """Set the end of the running job."""
        job = self.queue.job
        if job is None or job.number != message.job:
            return "STATE"
        if message.end_index != self.queue.next_index:
            return "INDEX"
        job.end_index = message.end_index
        if self.queue.is_job_done:
            self._finish_job()
        self._resume_if_refilled()
        return ""

    def flush(self) -> str:
        """Drop the queue and the job. The board stays armed."""
        if self.state not in ARMED_STATES:
            return "STATE"
        if self.state == BoardState.ARMED:
            self.queue.drop()
        else:
            self._change_state(EventReason.FLUSH)
        return ""

    def _log(self, event: str, **fields: object) -> None:
        self._log_sink({"t_us": self.now_us, "event": event, **fields})


def clip_code(code: float) -> int:
    """Return the code of a converter nearest to a measured one."""
    return min(max(round(code), 0), 0xFFFF)
