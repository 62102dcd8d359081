"""Examination of a board without a configuration and without arming: handshake, clock, inputs, LEASE and ABORT."""

import secrets
from typing import TypeVar

from optodrive.cli.doctor_board import check_inputs, check_trip, describe_failure
from optodrive.cli.output import Finding, report_ok, report_problem, report_warning
from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import HostConnection
from optodrive.link.protocol.transcript import describe_reset_cause
from optodrive.link.session.arming import FRAME_BYTES, PROTOCOL_MAJOR, TICK_HZ
from optodrive.link.session.board_view import get_fault_hint
from optodrive.link.session.clock_sync import DRIFT_MAX
from optodrive.link.transport.base import Transport

ANSWER_MAX_S = 3.0
REPEAT_S = 0.25
READ_S = 0.005
CLOCK_SPAN_S = 2.0
CLOCK_INTERVAL_S = 0.02
LEASE_MS = 100
TRIGGER_MINOR = 1
"""Minor version of the protocol since which a board has a trigger input."""

Answer = TypeVar("Answer", bound=m.Message)


def check_bare_board(transport: Transport, clock: Clock) -> list[Finding]:
    """Connect to a board and examine it with the gate off. It stays DISARMED."""
    conversation = _Conversation(transport, clock)
    try:
        transport.open()
        return _examine(conversation)
    except (LinkError, InputError) as error:
        return [describe_failure(error)]
    finally:
        transport.release()


class _Conversation:
    """Questions to a board, each repeated until it is answered."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._transport, self.clock = transport, clock
        self._connection = HostConnection()

    def _transmit(self) -> None:
        self._transport.write(self._connection.bytes_to_send(self.clock.now_s(), FRAME_BYTES))

    def ask(self, question: m.Message, kind: type[Answer]) -> Answer:
        """Return the answer of a kind to a message that is not sequenced. Raise LinkError if there is none."""
        until_s = self.clock.now_s() + ANSWER_MAX_S
        while self.clock.now_s() < until_s:
            if isinstance(question, m.Hello):
                self._connection.send_hello(question.host_nonce)
            else:
                self._connection.send(question)
            self._transmit()
            repeat_s = self.clock.now_s() + REPEAT_S
            while self.clock.now_s() < repeat_s:
                data = self._transport.read(READ_S)
                for message in self._connection.receive_bytes(data, self.clock.now_s()):
                    if isinstance(message, kind):
                        return message
        raise LinkError(f"no answer to {question.NAME} within {ANSWER_MAX_S:g} s")

    def greet(self) -> m.HelloReply:
        """Begin a session."""
        return self.ask(m.Hello(m.MAJOR, m.MINOR, secrets.randbits(32)), m.HelloReply)

    def tell(self, message: m.Message) -> None:
        """Send a message that has no answer."""
        self._connection.send(message)
        self._transmit()

    def abort(self) -> None:
        """Send ABORT, which ends the session."""
        self._connection.abort()
        self._transmit()

    def get_status(self) -> m.Status:
        """Return the board's status."""
        return self.ask(m.Get(), m.Status)


def _examine(conversation: _Conversation) -> list[Finding]:
    peer = conversation.greet()
    status = conversation.get_status()
    findings = [_check_identity(peer, status), *_report_capacities(peer), check_inputs(status.inputs)]
    if peer.capabilities & m.CAPABILITY_XY2_100:
        findings.append(_check_head(status.head))
    findings += _check_clock(conversation, peer.tick_hz)
    if peer.minor >= TRIGGER_MINOR:
        findings.append(_report_triggers(conversation.ask(m.GetTriggers(), m.Triggers), status))
    return [*findings, _check_stop(conversation, status)]


def _check_identity(peer: m.HelloReply, status: m.Status) -> Finding:
    state, fault = m.STATES[status.state], m.FAULTS[status.fault]
    firmware = f"firmware {peer.firmware >> 16}.{peer.firmware & 0xFFFF}"
    protocol = f"protocol {peer.major}.{peer.minor}"
    cause = describe_reset_cause(peer.reset_cause)
    observation = f"uid {peer.uid.hex()}, {firmware}, {protocol}, last start: {cause}, {state}"
    if peer.major != PROTOCOL_MAJOR:
        return report_problem("board", observation, f"expected protocol {PROTOCOL_MAJOR}: flash another firmware")
    if fault:
        return report_warning("board", f"{observation} {fault}", get_fault_hint(fault))
    return report_ok("board", observation)


def _report_capacities(peer: m.HelloReply) -> list[Finding]:
    limits = peer.limits
    tables = f"{peer.queue_points} points, {peer.window_pulses} pulses a second, {peer.cells} cells"
    spot = f"spot at most {limits.spot_uj * 1e-3:g} mJ and {limits.spot_leak_uw * 1e-3:g} mW"
    pulse = f"pulse at most {limits.max_on_us * 1e-3:g} ms, full power {limits.full_power_uw * 1e-6:g} W"
    return [
        report_ok("capacities", f"{tables} of {peer.cell_codes} codes"),
        report_ok("limits", f"{pulse}, {spot}, lease {limits.lease_ms} ms"),
    ]


def _check_head(status: int) -> Finding:
    """Return the finding on a digital scan head. status: its last one, 0 for none."""
    if not status:
        return report_problem("scan head", "no valid status", "check plug, supply and wires of STATUS")
    lacking = [name for bit, name in m.HEAD_BITS.items() if not status & bit]
    if lacking:
        remedy = "see its manual; some need a while after power-up"
        return report_problem("scan head", f"{' and '.join(lacking)} not in order, status {status:#06x}", remedy)
    return report_ok("scan head", f"ready, status {status:#06x}")


def _report_triggers(triggers: m.Triggers, at_begin: m.Status) -> Finding:
    """Return the finding on the trigger input, which saw some time of the examination."""
    if not triggers.count:
        return report_ok("trigger", "no edge yet")
    seen = "during this examination" if triggers.tick > at_begin.tick else "before this examination"
    return report_ok("trigger", f"{triggers.count} edges since power-up, the last one {seen}")


def _check_clock(conversation: _Conversation, tick_hz: int) -> list[Finding]:
    """Compare the clocks over CLOCK_SPAN_S, by the narrowest exchange at its begin and at its end."""
    clock = conversation.clock
    exchanges: list[tuple[float, float, float]] = []
    until_s = clock.now_s() + CLOCK_SPAN_S
    while clock.now_s() < until_s:
        request_s = clock.now_s()
        reply = conversation.ask(m.ClockRequest(len(exchanges)), m.ClockReply)
        reply_s = clock.now_s()
        if reply.host_t == len(exchanges):
            exchanges.append((reply_s - request_s, 0.5 * (request_s + reply_s), reply.tick / tick_hz))
        clock.sleep(CLOCK_INTERVAL_S)
    if len(exchanges) < 2:
        raise LinkError("the board does not return the stamps of CLOCK")
    quarter = max(1, len(exchanges) // 4)
    (first_s, first_host_s, first_board_s), (last_s, last_host_s, last_board_s) = (
        min(exchanges[:quarter]),
        min(exchanges[-quarter:]),
    )
    elapsed_s = last_host_s - first_host_s
    ahead = (last_board_s - first_board_s) / elapsed_s - 1.0
    uncertainty = 0.5 * (first_s + last_s) / elapsed_s
    observation = f"{ahead * 1e6:+.0f} ± {uncertainty * 1e6:.0f} ppm against this computer"
    if tick_hz != TICK_HZ:
        rate = report_problem("clock", f"{tick_hz} ticks a second", f"expected {TICK_HZ}: flash another firmware")
    elif abs(ahead) > DRIFT_MAX + uncertainty:
        rate = report_problem("clock", observation, "check the board's crystal, and this computer's clock")
    else:
        rate = report_ok("clock", observation)
    return [rate, check_trip(min(each[0] for each in exchanges))]


def _check_stop(conversation: _Conversation, before: m.Status) -> Finding:
    """Check that neither a lease alone nor ABORT changes the state of a board that is not armed."""
    conversation.tell(m.Lease(LEASE_MS))
    leased = conversation.get_status()
    conversation.abort()
    conversation.greet()
    stopped = conversation.get_status()
    for after, status in (("LEASE", leased), ("ABORT", stopped)):
        if status.state != before.state or status.queued or status.laser_on_us != before.laser_on_us:
            state = f"{m.STATES[status.state]} {m.FAULTS[status.fault]}".strip()
            observation = f"{state} after {after}, {status.queued} points queued, laser on for {status.laser_on_us} µs"
            remedy = "examine it again; if it recurs, do not connect a laser to this firmware"
            return report_problem("lease, stop", observation, remedy)
    return report_ok("lease, stop", "a lease alone changes nothing; ABORT is taken; the gate was never on")
