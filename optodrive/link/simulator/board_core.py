"""The simulated board, sans-I/O: bytes and inputs in at given times, bytes and log events out.

`BoardMachine` decides what a message does; this module decodes the message, in order (B12) and undamaged (B13), and
encodes the answer.
"""

import random
from collections.abc import Callable
from math import cos, pi
from typing import Any, NamedTuple

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import WINDOW, BoardLink
from optodrive.link.protocol.framing import Frame, encode_frame
from optodrive.link.protocol.states import BoardState, EventReason
from optodrive.link.simulator.board_machine import BoardMachine, LogSink, MirrorSink
from optodrive.link.simulator.guards import INTERFACES, BoardSettings
from optodrive.link.simulator.measured_mirrors import MeasuredMirrors, MirrorSource

WANDER_PERIOD_S = 600.0


class BoardClock(NamedTuple):
    """Reading of a board's clock over true time, both from the board's start, s.

    drift, wander: constant relative error of the rate, and amplitude of one with a period of ten minutes
    offset_s: reading at the start
    """

    drift: float = 0.0
    wander: float = 0.0
    offset_s: float = 0.0

    def read_s(self, true_s: float) -> float:
        """Return the reading at a true time."""
        wandered_s = self.wander * WANDER_PERIOD_S / (2 * pi) * (1.0 - cos(2 * pi * true_s / WANDER_PERIOD_S))
        return self.offset_s + (1.0 + self.drift) * true_s + wandered_s

    def find_true_s(self, reading_s: float) -> float:
        """Return the true time of a reading."""
        true_s = reading_s - self.offset_s
        for _ in range(4):  # the rate differs from 1 by 1e-4 at most: each step adds four digits
            true_s += reading_s - self.read_s(true_s)
        return true_s


EXACT_CLOCK = BoardClock()


TICK_HZ = 1_000_000
FIRMWARE = 0x0001_0000
TEMPERATURE_DC = 250
HEAD_OK = 0xFDFD
"""Status of a scan head: power, temperature and positions in order."""


class BoardCore:
    """A board from power-up on.

    sink: receives each log event as a dict with its time t_us; mirror_sink: receives each move of the mirrors
    mirror_source: where the mirrors are, None for mirrors that follow at once
    seed: of session numbers and nonces, None for unpredictable ones
    """

    def __init__(
        self,
        settings: BoardSettings | None = None,
        sink: LogSink | None = None,
        seed: int | None = None,
        mirror_sink: MirrorSink | None = None,
        mirror_source: MirrorSource | None = None,
    ) -> None:
        self._settings = settings or BoardSettings()
        self._is_digital = self._settings.interface != INTERFACES[0]
        self._sink: LogSink = sink or (lambda event: None)
        self._random = random.Random(seed)
        self.read_present_us: Callable[[], int] = lambda: self.machine.now_us
        """Present time. A process that ran late processes bytes as of the time at which a board would have got them."""
        self.mirrors = MeasuredMirrors(mirror_source)

        def move(x: int, y: int, at_us: int) -> None:
            self.mirrors.move_to(x, y, at_us)
            if mirror_sink is not None:
                mirror_sink(x, y, at_us)

        self.machine = BoardMachine(self._settings, self._random, self._sink, move, self.mirrors.read, self._send)
        self._power_up(reset_cause=0)

    def _power_up(self, reset_cause: int) -> None:
        self._reset_cause = reset_cause
        self._link = BoardLink()
        self._output: list[bytes] = []
        self._ack_due = False
        self.machine.power_up()

    @property
    def state(self) -> BoardState:
        """The board's state."""
        return self.machine.state

    @property
    def fault(self) -> str:
        """The latched fault, '' if there is none."""
        return self.machine.fault

    @property
    def gate(self) -> bool:
        """Whether the gate is on."""
        return self.machine.gate

    @property
    def lease_until_us(self) -> int:
        """End of the lease, 0 before the first one."""
        return self.machine.lease_until_us

    # --- time and inputs ----------------------------------------------------------------------------------------

    def next_event_us(self) -> int | None:
        """Return the time of the next due event, None if there is none."""
        return self.machine.next_event_us()

    def advance(self, now_us: int) -> None:
        """Carry out each event due up to now_us and report executed points."""
        self.machine.advance(now_us)
        for report in self.machine.records.pop_reports():
            self._send(report)

    def set_input(self, name: str, value: bool, now_us: int) -> None:
        """Change an input: interlock (True: closed), key (True: on), estop (True: pressed)."""
        self.advance(now_us)
        self.machine.set_input(name, value)

    def inject_fault(self, kind: str, now_us: int) -> None:
        """Break mirror x in one of MIRROR_FAULTS, or repair it: ''."""
        self.advance(now_us)
        self.mirrors.inject_fault(kind, now_us)

    def receive_trigger(self, now_us: int) -> None:
        """Receive a rising edge at the trigger input."""
        self.advance(now_us)
        self.machine.receive_trigger()

    def on_link_lost(self, now_us: int) -> None:
        """Disarm as after an ABORT: the host's end of the link closed (DTR dropped, BREAK)."""
        self.advance(now_us)
        self.machine.disarm(EventReason.LINK_LOST)

    def reset(self, now_us: int, cause: int = 1) -> None:
        """Lose and regain power: the board forgets everything and its clock starts again."""
        self.advance(now_us)
        self.machine.power_down()
        self._power_up(cause)

    # --- frames -------------------------------------------------------------------------------------------------

    def bytes_to_send(self) -> bytes:
        """Return the bytes for the host since the last call."""
        data = b"".join(self._output)
        self._output.clear()
        return data

    def receive(self, data: bytes, now_us: int) -> None:
        """Process bytes that arrived at now_us."""
        self.advance(now_us)
        bad_frames = self._count_bad_frames()
        for frame in self._link.decoder.feed(data):
            self._handle_frame(frame)
        if self._count_bad_frames() != bad_frames:
            self._sink({"t_us": self.machine.now_us, "event": "rx_error", "bad_frames": self._count_bad_frames()})
        if self._ack_due:
            self._ack_due = False
            queue = self.machine.queue
            free = self._settings.queue_points - len(queue)
            self._send(m.Ack(self._link.expected_seq, free, queue.done_index, m.STATES.index(self.state)))
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
            self.machine.disarm(EventReason.ABORT)
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
            answer = m.NAK_REASONS.index(refusal) if refusal else None
            if refusal != "NO_ROOM":
                self._link.mark_consumed(answer)
        if answer is None:
            self._ack_due = True
        else:
            self._send(m.Nak(self._link.expected_seq, answer))

    def _handle_unsequenced(self, message: m.Message) -> None:
        if isinstance(message, m.Lease):
            self.machine.renew_lease(message.ms)
        elif isinstance(message, m.ClockRequest):
            # Not the time as of which the bytes are processed: that may lie before the host sent the request.
            self._send(m.ClockReply(message.host_t, self.read_present_us() - self.machine.epoch_us))
        elif isinstance(message, m.Get):
            self._send(self._build_status())
        elif isinstance(message, m.GetExecuted):
            report = self.machine.records.build_report(message.first_index)
            if report is not None:
                self._send(report)
        elif isinstance(message, m.GetTriggers):
            self._send(m.Triggers(self.machine.triggers, self.machine.trigger_tick))

    # --- messages -----------------------------------------------------------------------------------------------

    def _dispatch_sequenced(self, message: m.Message) -> str:
        """Carry out a sequenced message. Return the NAK reason, or '' if it is accepted."""
        handlers: dict[type[m.Message], Callable[[Any], str]] = {
            m.Limits: self.machine.tighten_limits,
            m.Data: self._on_data,
            m.Start: self.machine.start_job,
            m.StartOnTrigger: self.machine.start_job_on_trigger,
            m.End: self.machine.end_job,
            m.ArmReq: self._on_arm_req,
            m.ArmConfirm: self._on_arm_confirm,
            m.Disarm: self._on_disarm,
            m.ClearFault: lambda message: self.machine.clear_fault(),
            m.Flush: lambda message: self.machine.flush(),
        }
        return handlers[type(message)](message)

    def _on_hello(self, hello: m.Hello) -> None:
        self.machine.disarm(EventReason.HELLO)
        session = self._random.randrange(1, 1 << 16)
        while session == self._link.session:
            session = self._random.randrange(1, 1 << 16)
        self._link.begin_session(session)
        self.machine.begin_session(hello.major == m.MAJOR)
        self._output.clear()
        self._ack_due = False
        self._send(
            m.HelloReply(
                major=m.MAJOR,
                minor=m.MINOR,
                host_nonce=hello.host_nonce,
                session=session,
                firmware=FIRMWARE,
                uid=bytes.fromhex(self._settings.uid),
                capabilities=m.CAPABILITY_EXACT_WIDTHS
                + m.CAPABILITY_KEY_EDGE * self._settings.key_edge
                + m.CAPABILITY_XY2_100 * self._is_digital
                + m.CAPABILITY_FEEDBACK * (self._settings.feedback_codes > 0),
                tick_hz=TICK_HZ,
                queue_points=self._settings.queue_points,
                rx_window=WINDOW,
                cell_codes=self._settings.cell_codes,
                cells=self._settings.cells,
                window_pulses=self._settings.window_pulses,
                reset_cause=self._reset_cause,
                limits=self.machine.limits,
            )
        )

    def _on_data(self, message: m.Data) -> str:
        return self.machine.queue_points(message.first_index, m.POINT.iter_unpack(message.points))

    def _on_arm_req(self, message: m.ArmReq) -> str:
        refusal = self.machine.request_arming(message.host_nonce)
        challenge = self.machine.challenge
        if not refusal and challenge is not None:
            self._send(m.ArmChallenge(*challenge))
        return refusal

    def _on_arm_confirm(self, message: m.ArmConfirm) -> str:
        return self.machine.confirm_arming(message.host_nonce, message.board_nonce)

    def _on_disarm(self, message: m.Disarm) -> str:
        self.machine.disarm(EventReason.DISARM)
        return ""

    def _build_status(self) -> m.Status:
        counters, machine = self._link.decoder.counters, self.machine
        return m.Status(
            state=m.STATES.index(machine.state),
            fault=m.FAULTS.index(machine.fault),
            inputs=sum(1 << k for k, name in enumerate(m.INPUTS) if machine.inputs[name]),
            tick=machine.current_tick,
            done_index=machine.queue.done_index,
            queued=len(machine.queue),
            crc_errors=counters.crc_errors & 0xFFFF,
            format_errors=counters.format_errors & 0xFFFF,
            seq_errors=self._link.seq_errors & 0xFFFF,
            underruns=machine.underruns_total & 0xFFFF,
            laser_on_us=machine.laser_on_duty_us // 65535,
            temperature_dc=TEMPERATURE_DC,
            head=HEAD_OK if self._is_digital else 0,
            mirror_x=machine.measured_codes[0],
            mirror_y=machine.measured_codes[1],
        )

    def _send(self, message: m.Message) -> None:
        if self._link.session:
            self._output.append(encode_frame(Frame(message.TYPE, 0, self._link.session, message.encode_body())))
