"""The simulated board, sans-I/O: bytes and inputs in at given times, bytes and log events out.

It enforces B1 to B13 of PROTOCOL.md. Time is whole microseconds and advances only when told; what falls due in
between is done, and logged, at its exact time.
"""

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import WINDOW, BoardLink
from optodrive.link.protocol.framing import Frame, encode_frame
from optodrive.link.simulator.board_limits import BoardSettings, tighten
from optodrive.link.simulator.guards import EmissionGuards

INDICATOR_US = 2_000_000
ARMING_TIMEOUT_US = 10_000_000
HOLD_MAX_US = 1_000_000
UNDERRUNS_MAX = 3
UNDERRUN_WINDOW_US = 10_000_000
RING_RECORDS = 8192
INDEX_MAX = 0xFFFF_FFFF
TICK_HZ = 1_000_000
FIRMWARE = 0x0001_0000
CAPABILITY_KEY_EDGE = 1
LEASED_STATES = ("ARMING", "ARMED", "RUNNING", "HOLD")
SAFE_INPUTS = {"interlock": True, "key": True, "estop": False}
INPUT_FAULTS = {"interlock": "INTERLOCK", "key": "KEY", "estop": "ESTOP"}

LogSink = Callable[[dict[str, Any]], None]
MirrorSink = Callable[[int, int, int], None]
"""Told where the mirrors are sent, x and y in codes, and when, µs."""
ExecutionRecord = tuple[int, int, int, int]
"""Number of the point, tick of gate on, gate-on time, duty."""


class QueuedPoint(NamedTuple):
    """One queued point; number: its index over the session."""

    number: int
    x: int
    y: int
    dark_us: int
    on_us: int
    duty: int


@dataclass
class BoardJob:
    """The job between START and its end."""

    number: int
    start_us: int
    watermark: int
    end_index: int | None = None


class BoardCore:
    """A board from power-up on. sink: gets every log event as a dict with t_us; steer: what stands for the mirrors."""

    def __init__(
        self,
        settings: BoardSettings | None = None,
        sink: LogSink | None = None,
        seed: int | None = None,
        mirror_sink: MirrorSink | None = None,
    ) -> None:
        self._settings = settings or BoardSettings()
        self._sink: LogSink = sink or (lambda event: None)
        self._mirror_sink: MirrorSink = mirror_sink or (lambda x, y, at_us: None)
        self._random = random.Random(seed)
        self._now_us = 0
        self.inputs = dict(SAFE_INPUTS)
        self.gate = False
        self._power_up(reset_cause=0)

    def _power_up(self, reset_cause: int) -> None:
        self._epoch_us = self._now_us
        self._reset_cause = reset_cause
        self.state, self.fault = "BOOT", ""
        self._link = BoardLink()
        self._out: list[bytes] = []
        self._limits = self._settings.limits
        self._guards = EmissionGuards(self._settings.cell_codes)
        self._queue: deque[QueuedPoint] = deque()
        self._position = (32768, 32768)
        self._mirror_sink(*self._position, self._now_us)
        self._settled_us = self._now_us
        self._job: BoardJob | None = None
        self._current_point: QueuedPoint | None = None
        self._gate_on_us = self._due_us = 0
        self._next_index = self._done_index = 0
        self._records: deque[ExecutionRecord] = deque(maxlen=RING_RECORDS)
        self._unreported: list[ExecutionRecord] = []
        self._lease_until_us = 0
        self._board_nonce: int | None = None
        self._arming_host_nonce: int | None = None
        self._arming_since_us = 0
        self._confirmed = False
        self._hold_since_us = 0
        self._underrun_times_us: deque[int] = deque()
        self._underruns_total = 0
        self._laser_on_duty_us = 0
        self._key_turned = False
        self._is_version_supported = False
        self._ack_due = False
        self._set_state("DISARMED", "boot")

    # --- time ---------------------------------------------------------------------------------------------------

    def next_event_us(self) -> int | None:
        """When something falls due next, None when nothing does."""
        due = [self._point_due_us(), self._lease_due_us(), self._arming_due_us(), self._hold_due_us()]
        return min((at_us for at_us in due if at_us is not None), default=None)

    def advance(self, now_us: int) -> None:
        """Do everything that falls due up to now_us, in order and at its exact time."""
        while True:
            due_us = self.next_event_us()
            if due_us is None or due_us > now_us:
                break
            self._now_us = max(self._now_us, due_us)
            self._run_due_event()
        self._now_us = max(self._now_us, now_us)
        self._report_executed()

    def _run_due_event(self) -> None:
        now_us = self._now_us
        if is_due(self._lease_due_us(), now_us):
            self._enter_fault("LINK")
        elif is_due(self._arming_due_us(), now_us):
            self._finish_arming()
        elif is_due(self._hold_due_us(), now_us):
            self._disarm("hold too long")
        else:
            self._advance_point()

    def _lease_due_us(self) -> int | None:
        return self._lease_until_us if self.state in LEASED_STATES else None

    def _arming_due_us(self) -> int | None:
        if self.state != "ARMING":
            return None
        return self._arming_since_us + (INDICATOR_US if self._confirmed else ARMING_TIMEOUT_US)

    def _hold_due_us(self) -> int | None:
        if self.state == "HOLD":
            return self._hold_since_us + HOLD_MAX_US
        job = self._job
        if (
            self.state == "RUNNING"
            and self._current_point is None
            and job is not None
            and not self._has_enough_points(job)
        ):
            return job.start_us + HOLD_MAX_US
        return None

    def _point_due_us(self) -> int | None:
        if self.state != "RUNNING":
            return None
        if self._current_point is not None:
            return self._due_us
        return self._next_start_us()

    # --- points -------------------------------------------------------------------------------------------------

    def _next_start_us(self) -> int | None:
        """When the next point may begin: the job's start with enough queued, else not before more data."""
        job = self._job
        if job is None or not self._has_enough_points(job):
            return None
        return max(job.start_us, self._now_us)

    def _has_enough_points(self, job: BoardJob) -> bool:
        is_complete = job.end_index is not None and self._next_index >= job.end_index
        return bool(self._queue) and (is_complete or len(self._queue) >= job.watermark)

    def _advance_point(self) -> None:
        """A phase of the current point ended, or the first point of a job, or after a hold, begins."""
        point = self._current_point
        if point is None:
            self._begin_point(self._queue.popleft())
        elif not self.gate and point.on_us:
            self._begin_pulse(point)
        else:
            self._finish_point(point)

    def _begin_point(self, point: QueuedPoint) -> None:
        move = max(abs(point.x - self._position[0]), abs(point.y - self._position[1]))
        if move:
            settle_us = self._limits.settle_us + -(-move * self._limits.settle_ns_per_code // 1000)
            # A move that was broken off may have left the mirrors anywhere on its way: its own time counts too.
            self._settled_us = max(self._settled_us, self._now_us) + settle_us
        self._position = point.x, point.y
        self._mirror_sink(point.x, point.y, self._now_us)
        self._current_point = point
        self._due_us = max(self._now_us + point.dark_us, self._settled_us)

    def _begin_pulse(self, point: QueuedPoint) -> None:
        fault = self._guards.check_pulse(self._limits, point.x, point.y, self._now_us, point.on_us, point.duty)
        if fault:
            self._enter_fault(fault)
            return
        self._guards.record_pulse(self._limits, point.x, point.y, self._now_us, point.on_us, point.duty)
        self._gate_on_us = self._now_us
        self._due_us = self._now_us + point.on_us
        self._set_gate(True, f"point {point.number}")

    def _finish_point(self, point: QueuedPoint) -> None:
        gate_was_on = self.gate
        if gate_was_on:
            self._set_gate(False, f"point {point.number} done")
        self._record_execution(
            point, self._gate_on_us if gate_was_on else self._now_us, point.on_us if gate_was_on else 0
        )
        self._current_point = None
        job = self._job
        if job is not None and job.end_index is not None and self._done_index >= job.end_index:
            self._job = None
            self._set_state("ARMED", "job done")
        elif self._queue:
            self._begin_point(self._queue.popleft())
        else:
            self._on_underrun()

    def _record_execution(self, point: QueuedPoint, on_at_us: int, on_us: int) -> None:
        self._done_index = point.number + 1
        self._laser_on_duty_us += on_us * point.duty
        record = point.number, on_at_us - self._epoch_us, on_us, point.duty if on_us else 0
        self._records.append(record)
        self._unreported.append(record)
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

    def _on_underrun(self) -> None:
        self._underruns_total += 1
        self._underrun_times_us.append(self._now_us)
        while self._underrun_times_us[0] < self._now_us - UNDERRUN_WINDOW_US:
            self._underrun_times_us.popleft()
        if len(self._underrun_times_us) >= UNDERRUNS_MAX:
            self._enter_fault("UNDERRUN")
            return
        self._hold_since_us = self._now_us
        self._set_state("HOLD", "queue empty")

    def _resume_if_refilled(self) -> None:
        if self.state == "HOLD" and self._job is not None and self._has_enough_points(self._job):
            self._set_state("RUNNING", "refilled")

    # --- states -------------------------------------------------------------------------------------------------

    def _set_gate(self, on: bool, reason: str) -> None:
        if on != self.gate:
            self.gate = on
            self._log("gate", on=on, reason=reason)

    def _set_state(self, state: str, reason: str) -> None:
        if state != "RUNNING":
            self._close_gate(reason)
        previous, self.state = self.state, state
        self._log("state", state=state, before=previous, reason=reason)
        self._send(
            m.Event(
                m.STATES.index(state), m.FAULTS.index(self.fault), m.EVENT_REASONS.index(reason), self._current_tick()
            )
        )

    def _close_gate(self, reason: str) -> None:
        """Gate off; what a cut-short pulse really did is recorded."""
        point, gate_was_on = self._current_point, self.gate
        self._set_gate(False, reason)
        if point is not None and gate_was_on:
            self._record_execution(point, self._gate_on_us, self._now_us - self._gate_on_us)
        self._current_point = None

    def _drop_queue(self) -> None:
        self._queue.clear()
        self._job = None
        self._done_index = self._next_index

    def _disarm(self, reason: str) -> None:
        self._confirmed = False
        self._board_nonce = None
        if self.state not in ("DISARMED", "FAULT"):
            self._set_state("DISARMED", reason)
        self._drop_queue()

    def _enter_fault(self, fault: str) -> None:
        if self.state != "FAULT":
            self.fault = fault
            self._log("fault", fault=fault)
            self._set_state("FAULT", "fault")
        self._confirmed = False
        self._board_nonce = None
        self._drop_queue()

    def _finish_arming(self) -> None:
        if self._confirmed:
            self._set_state("ARMED", "armed")
        else:
            self._disarm("arming timed out")

    # --- the world outside --------------------------------------------------------------------------------------

    def set_input(self, name: str, value: bool, now_us: int) -> None:
        """An input changes: interlock (True: closed), key (True: on), estop (True: pressed)."""
        self.advance(now_us)
        if name == "key" and value and not self.inputs["key"]:
            self._key_turned = True
        self.inputs[name] = value
        self._log("input", input=name, value=value)
        if value != SAFE_INPUTS[name]:
            self._enter_fault(INPUT_FAULTS[name])

    def on_link_lost(self, now_us: int) -> None:
        """The host's end of the link closed (DTR dropped, BREAK): as an ABORT."""
        self.advance(now_us)
        self._disarm("link lost")

    def reset(self, now_us: int, cause: int = 1) -> None:
        """Power lost and back: everything is forgotten, the clock starts again."""
        self.advance(now_us)
        self._set_gate(False, "reset")
        self._current_point = None
        self._power_up(cause)

    # --- bytes --------------------------------------------------------------------------------------------------

    def bytes_to_send(self) -> bytes:
        """Bytes for the host since the last call."""
        out = b"".join(self._out)
        self._out.clear()
        return out

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes that arrived at now_us."""
        self.advance(now_us)
        bad = self._count_bad_frames()
        for frame in self._link.decoder.feed(data):
            self._handle_frame(frame)
        if self._count_bad_frames() != bad:
            self._log("rx_error", bad_frames=self._count_bad_frames())
        if self._ack_due:
            self._ack_due = False
            free = self._settings.queue_points - len(self._queue)
            state = m.STATES.index(self.state)
            self._send(m.Ack(self._link.expected_seq, free, self._done_index, state))
        self.advance(now_us)

    def _count_bad_frames(self) -> int:
        counters = self._link.decoder.counters
        return counters.crc_errors + counters.format_errors

    def _handle_frame(self, frame: Frame) -> None:
        try:
            message = m.parse_message(frame.type, frame.body)
        except RemoteProtocolError:
            self._link.decoder.counters.format_errors += 1
            return
        if isinstance(message, m.Abort):
            self._disarm("abort")
        elif isinstance(message, m.Hello):
            self._on_hello(message)
        elif frame.session != self._link.session or not self._link.session or not isinstance(message, m.HOST_MESSAGES):
            self._link.seq_errors += 1
        elif message.SEQUENCED:
            self._handle_sequenced(frame.seq, message)
        else:
            self._handle_unsequenced(message)

    def _handle_sequenced(self, seq: int, message: m.Message) -> None:
        is_expected, answer = self._link.accept(seq)
        if is_expected:
            refusal = self._dispatch_sequenced(message)
            if refusal == "NO_ROOM":
                answer = m.NAK_REASONS.index(refusal)
            else:
                answer = m.NAK_REASONS.index(refusal) if refusal else None
                self._link.mark_consumed(answer)
        if answer is None:
            self._ack_due = True
        else:
            self._send(m.Nak(self._link.expected_seq, answer))

    def _handle_unsequenced(self, message: m.Message) -> None:
        if isinstance(message, m.Lease) and self.state in LEASED_STATES:
            until_us = self._now_us + 1000 * min(message.ms, self._limits.lease_ms)
            self._lease_until_us = max(self._lease_until_us, until_us)
        elif isinstance(message, m.ClockRequest):
            self._send(m.ClockReply(message.host_t, self._current_tick()))
        elif isinstance(message, m.Get):
            self._send(self._build_status())
        elif isinstance(message, m.GetExecuted):
            records = [record for record in self._records if record[0] >= message.first_index]
            self._send_records(select_one_report(records))

    def _dispatch_sequenced(self, message: m.Message) -> str:
        """Carry a sequenced message out; the NAK reason where it is refused."""
        handlers: dict[type[m.Message], Callable[[Any], str]] = {
            m.Limits: self._on_limits,
            m.Data: self._on_data,
            m.Start: self._on_start,
            m.End: self._on_end,
            m.ArmReq: self._on_arm_req,
            m.ArmConfirm: self._on_arm_confirm,
            m.Disarm: self._on_disarm,
            m.ClearFault: self._on_clear_fault,
            m.Flush: self._on_flush,
        }
        return handlers[type(message)](message)

    def _on_hello(self, hello: m.Hello) -> None:
        self._disarm("hello")
        session = self._random.randrange(1, 1 << 16)
        while session == self._link.session:
            session = self._random.randrange(1, 1 << 16)
        self._link.begin_session(session)
        self._limits = self._settings.limits
        self._next_index = self._done_index = 0
        self._records.clear()
        self._unreported.clear()
        self._out.clear()
        self._ack_due = False
        self._is_version_supported = hello.major == m.MAJOR
        self._send(
            m.HelloReply(
                major=m.MAJOR,
                minor=m.MINOR,
                host_nonce=hello.host_nonce,
                session=session,
                firmware=FIRMWARE,
                uid=bytes.fromhex(self._settings.uid),
                capabilities=CAPABILITY_KEY_EDGE if self._settings.key_edge else 0,
                tick_hz=TICK_HZ,
                queue_points=self._settings.queue_points,
                rx_window=WINDOW,
                cell_codes=self._settings.cell_codes,
                reset_cause=self._reset_cause,
                limits=self._limits,
            )
        )

    def _on_limits(self, message: m.Limits) -> str:
        if self.state not in ("DISARMED", "FAULT"):
            return "STATE"
        self._limits = tighten(self._limits, message)
        return ""

    def _on_data(self, message: m.Data) -> str:
        if self.state not in ("ARMED", "RUNNING", "HOLD"):
            return "STATE"
        idle = self._job is None and not self._queue
        if message.first_index < self._next_index or (message.first_index > self._next_index and not idle):
            return "INDEX"
        points = [
            QueuedPoint(message.first_index + k, *values)
            for k, values in enumerate(m.POINT.iter_unpack(message.points))
        ]
        if message.first_index + len(points) > INDEX_MAX:
            return "INDEX"
        if len(self._queue) + len(points) > self._settings.queue_points:
            return "NO_ROOM"
        for point in points:
            fault = self._check_point(point)
            if fault:
                self._enter_fault(fault)
                return "STATE"
        if idle:
            self._done_index = message.first_index
        self._queue.extend(points)
        self._next_index = message.first_index + len(points)
        self._resume_if_refilled()
        return ""

    def _check_point(self, point: QueuedPoint) -> str:
        limits = self._limits
        if not (limits.x_min <= point.x <= limits.x_max and limits.y_min <= point.y <= limits.y_max):
            return "RANGE"
        if point.on_us > limits.max_on_us:
            return "ON_TIME"
        if point.duty > limits.max_duty:
            return "DUTY"
        return ""

    def _on_start(self, message: m.Start) -> str:
        if self.state != "ARMED":
            return "STATE"
        if message.first_index != (self._queue[0].number if self._queue else self._next_index):
            return "INDEX"
        start_us = max(self._epoch_us + message.start_tick, self._now_us)
        self._job = BoardJob(message.job, start_us, message.watermark)
        self._set_state("RUNNING", "start")
        return ""

    def _on_end(self, message: m.End) -> str:
        job = self._job
        if job is None or job.number != message.job:
            return "STATE"
        if message.end_index != self._next_index:
            return "INDEX"
        job.end_index = message.end_index
        if self._done_index >= message.end_index:
            self._job = None
            self._set_state("ARMED", "job done")
        self._resume_if_refilled()
        return ""

    def _on_arm_req(self, message: m.ArmReq) -> str:
        if self.state != "DISARMED":
            return "STATE"
        if not self._is_version_supported:
            return "VERSION"
        if self.inputs != SAFE_INPUTS:
            return "INPUT"
        if self._settings.key_edge and not self._key_turned:
            return "KEY_EDGE"
        self._board_nonce = self._random.getrandbits(32)
        self._arming_host_nonce = message.host_nonce
        self._arming_since_us = self._now_us
        self._confirmed = False
        self._lease_until_us = self._now_us + 1000 * self._limits.lease_ms
        self._set_state("ARMING", "arm requested")
        self._send(m.ArmChallenge(message.host_nonce, self._board_nonce))
        return ""

    def _on_arm_confirm(self, message: m.ArmConfirm) -> str:
        nonce, self._board_nonce = self._board_nonce, None
        if self.state != "ARMING" or self._confirmed:
            return "STATE"
        if nonce is None or message.board_nonce != nonce or message.host_nonce != self._arming_host_nonce:
            self._disarm("disarm")
            return "NONCE"
        self._confirmed = True
        self._key_turned = False
        return ""

    def _on_disarm(self, message: m.Disarm) -> str:
        self._disarm("disarm")
        return ""

    def _on_clear_fault(self, message: m.ClearFault) -> str:
        if self.state != "FAULT":
            return "STATE"
        if self.inputs != SAFE_INPUTS:
            return "INPUT"
        self.fault = ""
        self._underrun_times_us.clear()
        self._set_state("DISARMED", "fault cleared")
        return ""

    def _on_flush(self, message: m.Flush) -> str:
        if self.state not in ("ARMED", "RUNNING", "HOLD"):
            return "STATE"
        if self.state != "ARMED":
            self._set_state("ARMED", "flush")
        self._drop_queue()
        return ""

    def _build_status(self) -> m.Status:
        counters = self._link.decoder.counters
        bits = sum(1 << k for k, name in enumerate(m.INPUTS) if self.inputs[name])
        return m.Status(
            state=m.STATES.index(self.state),
            fault=m.FAULTS.index(self.fault),
            inputs=bits,
            tick=self._current_tick(),
            done_index=self._done_index,
            queued=len(self._queue),
            crc_errors=counters.crc_errors & 0xFFFF,
            format_errors=counters.format_errors & 0xFFFF,
            seq_errors=self._link.seq_errors & 0xFFFF,
            underruns=self._underruns_total & 0xFFFF,
            laser_on_us=self._laser_on_duty_us // 65535,
            temperature_dc=250,
        )

    def _report_executed(self) -> None:
        while self._unreported:
            report = select_one_report(self._unreported)
            self._send_records(report)
            del self._unreported[: len(report)]

    def _send_records(self, records: list[ExecutionRecord]) -> None:
        if records:
            self._send(m.Executed(records[0][0], tuple(record[1:] for record in records)))

    def _current_tick(self) -> int:
        return self._now_us - self._epoch_us

    def _send(self, message: m.Message) -> None:
        if self._link.session:
            self._out.append(encode_frame(Frame(message.TYPE, 0, self._link.session, message.encode_body())))

    def _log(self, event: str, **more: object) -> None:
        self._sink({"t_us": self._now_us, "event": event, **more})


def select_one_report(records: list[ExecutionRecord]) -> list[ExecutionRecord]:
    """As many from the first on as one EXECUTED can tell: numbers without a gap, offsets that fit 32 bits."""
    count = 0
    for number, on_tick, _, _ in records[: m.RECORDS_MAX]:
        if number != records[0][0] + count or on_tick - records[0][1] >= 1 << 32:
            break
        count += 1
    return records[:count]


def is_due(due_us: int | None, now_us: int) -> bool:
    return due_us is not None and due_us <= now_us
