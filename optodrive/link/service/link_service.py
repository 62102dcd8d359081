"""The link process without its sockets: epochs, the lease's conditions, commands of clients, status.

Theory of operation

Problem. Several processes act on one board: web for callers, the planner for plans, the supervisor, a shell. Any of
them may crash or stall with the laser on, and messages cross: a plan that was requested before STOP may arrive after
it, be accepted after the next arming, and light what nobody asks for any more.

Epochs. Everything that stops the light ends the epoch: STOP, disarm, a fault, a board that has left its arming, the
loss of the link, of the planner or of the web process, a revoked caller. A request carries the epoch of its arrival,
and its points are never lit in another one: the handover refuses them (gate 1, `point_handover.py`), and arming drops
those handed over before (gate 2, in the session). A successor of this process begins with a greater epoch. Its end
sends ABORT (DISARM where that was the command), also when the board is said to be dark already: that may be false.

Lease. It is renewed while the planner and a web process beat, and the planner is idle or makes progress (`control.py`):
a process that could not stop the light must not keep it on. With `on_web_loss = "finish"` a running plan may outlive
the web process, because a shell or the key can still stop it; then `UNATTENDED_MAX_S` bounds the dark rest.

Control. Who armed the board controls it: an arming may be held by a client that must prove its presence (hold-to-run),
and ends with it. One arming at a time; a second caller is told who arms.

Pauses are numbered and held here, as STOP is, so that they take effect however busy the planner is (decision 37).
Points that would be late, and the loss of a stage where the others go on, are interruptions of the same
kind that end by themselves.

Order of one `step`: bytes of the board first, then what follows from them (ends of epochs), then status, then the
answers to commands: a caller that learns from an answer that the board is armed may push at once, and the planner must
know it by then. Results wait until the board has confirmed (`control.py`); a caller never learns of a state before it
is true.

No method blocks and no client is waited for: the process has the highest priority of the daemon, its loop is bounded by
`WAIT_MAX_S`, and `pop_outgoing` returns what is to be sent. Malformed messages end their client, not the loop. The
interleavings are checked by a SPIN model (`firmware_protocol/model/epochs.pml`). Decisions: 35, 37.
"""

from typing import Any, NamedTuple

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.core.ipc import IpcError, Message
from optodrive.link.protocol.states import ARMED_STATES, LEASED_STATES
from optodrive.link.service.control import DISARM, PAUSE_MAX_S, STOP, Clients, Control, Epoch, Pauses, StateWaiters
from optodrive.link.service.link_connection import build_result
from optodrive.link.service.point_handover import PointHandover
from optodrive.link.service.settings import OnWebLoss
from optodrive.link.service.status import StatusPublisher
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.board_view import get_fault_hint

UNATTENDED_MAX_S = 5.0
"""Time for which an armed board without points may be without a web process, which starts again within 3 s."""
WAIT_MAX_S = 0.02
"""Longest wait of the loop, so that status and beats are in time."""


class Outgoing(NamedTuple):
    """Message for clients."""

    clients: tuple[int, ...]
    message: Message


class LinkService:
    """Core of the link process.

    Every method returns at once; the caller sends what `pop_outgoing` returns. Clients are numbers given by the caller.
    first_epoch: greater than every epoch of an earlier link process
    """

    def __init__(
        self,
        boards: BoardGroup,
        clock: Clock,
        on_web_loss: OnWebLoss = "dark",
        first_epoch: int = 1,
    ) -> None:
        self.epoch = Epoch(first_epoch)
        self._boards = boards
        self._clock = clock
        self._clients = Clients(on_web_loss, clock)
        self._waiters = StateWaiters()
        self._status = StatusPublisher(boards, clock)
        self.pauses = Pauses(clock)
        self._handover = PointHandover(boards, clock, self.epoch, self.pauses, self._send_to_planner)
        self._control: Control | None = None
        self._attended_s = 0.0
        self._seen_faults: list[str] = []
        self._outgoing: list[Outgoing] = []

    # --- clients ------------------------------------------------------------------------------------------------

    def on_message(self, client: int, message: Message, trusted: bool = True) -> None:
        """Carry out a client's message. trusted: whether the client runs as the user of this process.

        Raise IpcError for a message that the client may not send or that is malformed; the caller then ends it.
        """
        try:
            if message.kind == "hello":
                self._on_hello(client, str(message.fields["role"]), trusted)
                return
            self._clients.require_permission(client, message.kind)
            if message.kind == "beat":
                self._clients.record_beat(client, bool(message.fields["alive"]))
            elif message.kind in ("stop", "arm", "disarm", "pause", "resume"):
                self._command(client, message)
            elif message.kind == "revoke":
                self._revoke(str(message.fields["caller"]))
            elif message.kind == "hold":
                self._hold(int(message.fields["arming"]), float(message.fields["age_s"]))
            elif message.kind == "release":
                self._release(int(message.fields["arming"]), str(message.fields["reason"]))
            else:
                self._handover.carry_out(message)
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            raise IpcError(f"message {message.kind!r}: {error!r}") from None

    def _on_hello(self, client: int, role: str, trusted: bool) -> None:
        replaced = self._clients.add(client, role, trusted)
        if replaced is not None:
            self.on_client_lost(replaced)
            self._clients.add(client, role, trusted)
        if role == "planner":
            # The planner counts its commands per connection, to know when link has carried out all of them.
            self._handover.commands = 0
        self._status.mark_due()

    def on_client_lost(self, client: int) -> None:
        """Forget a client that has left. Without planner, or without web unless it may be lost, go dark.

        An arming that is not complete ends with its caller, even if a plan would continue.
        """
        # An arming whose caller is gone would complete with nobody who knows of it.
        is_arming = self._waiters.drop_client(client)
        reason = self._clients.remove(client) or ("the client that was arming the board has left" if is_arming else "")
        if reason:
            self.go_dark(reason)

    @property
    def planner(self) -> int | None:
        """Number of the planner, None without one."""
        return self._clients.planner

    def list_observers(self) -> tuple[int, ...]:
        """Return the clients that must stay connected: all but operators."""
        return self._clients.list_observers()

    def pop_outgoing(self) -> list[Outgoing]:
        """Return and remove the messages to send, in order."""
        outgoing, self._outgoing = self._outgoing, []
        return outgoing

    def _send_to_planner(self, message: Message) -> None:
        if self._clients.planner is not None:
            self._outgoing.append(Outgoing((self._clients.planner,), message))

    # --- commands -----------------------------------------------------------------------------------------------

    def _command(self, client: int, message: Message) -> None:
        command, request_id = message.kind, int(message.fields["id"])
        try:
            # Before the link is required: without it the board may still emit until its lease ends, and the epoch must
            # end now.
            if command == "stop":
                self.go_dark(STOP)
            elif command == "disarm":
                # No ABORT: in FAULT the command acknowledges, which ABORT does not.
                self._end_epoch(DISARM)
            self._require_link()
            if command == "disarm":
                self._boards.disarm()
            elif command == "arm":
                # Arming without a renewable lease would end in fault LEASE a moment later, with a cause that nobody
                # understands.
                self._clients.require_lease()
                self._require_no_control()
                self._boards.arm()
                # After the board took the request: a refusal must not leave a controller behind.
                self._control = self._build_control(message.fields)
            elif command == "pause":
                self._pause()
            elif command == "resume":
                self._require_armed("resumed")
                self.pauses.end()
                # At once: nothing is awaited, the planner hands over the rest when it is ready.
                self._reply(client, request_id, None)
                return
        except OptodriveError as error:
            self._reply(client, request_id, error)
            return
        self._waiters.add(client, request_id, command, self._clock.now_s())

    def _pause(self) -> None:
        """Turn the gate off, and permit no points until the light is resumed."""
        self._require_armed("paused")
        if not self.pauses.is_paused:
            # The number rises before the queue is dropped: points on their way from the planner are then refused.
            self.pauses.begin(self._boards.board_s())
            self._handover.pause()

    def _require_armed(self, purpose: str) -> None:
        state = self._boards.state
        if state not in ARMED_STATES:
            raise NotReadyError(f"the board is {state}; only an armed board can be {purpose}")

    def _require_no_control(self) -> None:
        """Raise NotReadyError while a caller is arming the board or has armed it: one arming at a time."""
        if self._control is not None:
            state = self._boards.state
            doing = "has armed the board" if state in ARMED_STATES else "is arming the board"
            raise NotReadyError(f"{self._control.describe_caller()} {doing}; only a DISARMED board can be armed")

    def _build_control(self, fields: dict[str, Any]) -> Control:
        """Build the control of an arming that is requested now. `hold`: whether it needs beats from now on."""
        now_s = self._clock.now_s()
        held_s = now_s if fields.get("hold") else None
        return Control(str(fields.get("caller", "")), now_s, int(fields.get("arming", 0)), held_s)

    def _hold(self, arming: int, age_s: float) -> None:
        """Record a beat of the client that holds an arming. age_s: time since it arrived."""
        # By number, not by caller: a beat of an earlier arming must not sustain a later one of the same token.
        if self._control is not None and self._control.arming == arming:
            self._control = self._control.record_beat(self._clock.now_s() - max(0.0, age_s))

    def _release(self, arming: int, reason: str) -> None:
        """Go dark if the client that held this arming has left."""
        if self._control is not None and self._control.arming == arming:
            self.go_dark(reason)

    def _revoke(self, caller: str) -> None:
        """Go dark if a caller has armed the board, or is arming it, whose token is no longer valid."""
        if self._control is not None and self._control.caller == caller:
            self.go_dark(f"the token {caller!r}, which armed the board, was revoked")

    def _require_link(self) -> None:
        if not self._boards.connected:
            raise LinkError(self._describe_link_error() or "no link to the board")

    def _describe_link_error(self) -> str:
        error = self._boards.link_error
        return "" if error is None else str(error)

    def _reply(self, client: int, request_id: int, error: OptodriveError | None) -> None:
        fields: dict[str, Any] = {"board": self._boards.board.to_dict(), "epoch": self.epoch.number}
        fields["pause"] = self.pauses.build_status()._asdict()
        self._outgoing.append(Outgoing((client,), build_result(request_id, error, fields)))

    def go_dark(self, reason: str) -> None:
        """End the epoch and abort: gate off, queue dropped, DISARMED. reason: for people, as the end of a sentence."""
        self._end_epoch(reason)
        self._boards.abort()

    def _end_epoch(self, reason: str) -> None:
        # First of all: what follows may raise, and the epoch must have ended by then.
        self.epoch.end(reason)
        self._control = None
        self.pauses.end()
        self._boards.end_arming()
        # It sends the reports that were collected before it forgets the jobs: the planner's heat needs them.
        self._handover.clear()
        for waiter in self._waiters.pop_ended():
            self._reply(waiter.client, waiter.request_id, NotReadyError(f"the board is not armed: {reason}"))

    # --- loop ---------------------------------------------------------------------------------------------------

    def compute_wait_s(self) -> float:
        """Return the longest time for which the loop may wait for bytes of port and clients before step(), s."""
        return min(self._boards.compute_wait_s(), WAIT_MAX_S)

    def step(self, wait_s: float = 0.0) -> None:
        """Send the due messages to the board and process its messages. wait_s: longest wait for its first byte."""
        if self._boards.connected:
            self._step_session(wait_s)
        else:
            self._boards.step_connecting()
        stalled = self._clients.find_stalled()
        control = self._control if self._boards.state in LEASED_STATES else None
        commands = self._handover.commands
        status = self._status.build_if_due(self.epoch, control, self.pauses, commands, stalled)
        if status is not None:  # before the results: who knows of ARMED from one may push to the planner at once
            self._outgoing.append(Outgoing(self._clients.list_observers(), status))
        refusal = self._boards.pop_refusal()
        now_s = self._clock.now_s()
        failed_arming: OptodriveError | None = None
        # After the board's messages of this step, so that no answer is older than the state it states.
        for waiter, error in self._waiters.pop_results(self._boards, refusal, self._describe_link_error(), now_s):
            self._reply(waiter.client, waiter.request_id, error)
            if error is not None and waiter.command == "arm":
                failed_arming = error
        # The caller was told that the board is not armed; without ABORT it might still become so.
        if failed_arming is not None and self._control is not None:
            self.go_dark(f"arming failed: {failed_arming}")
        if refusal is not None:
            self._send_to_planner(Message("refusal", {"reason": refusal}))
        # Reports before `drained`: the planner counts what was lit before it plans the rest.
        self._handover.report_progress()
        self._handover.finish_pause()

    def _step_session(self, wait_s: float) -> None:
        stalled = self._clients.find_stalled()
        try:
            # Before the sessions send: a point that is late on one board must not leave on another.
            self._interrupt(self._boards.describe_lateness())
            self._boards.step(wait_s, renew_lease=not stalled, stalled=stalled)
            # The others are dark until the lost one is so for certain.
            self._interrupt(self._boards.pop_loss())
            # The order of these follows the causes: a lost stage is an interruption, and only what is not one ends the
            # epoch.
            self._watch_board()
            self._end_unattended()
            self._end_abandoned()
            self._end_long_pause()
        except (LinkError, InputError):
            # No ABORT here: the group has sent it, or the link that would carry it is gone, and the lease ends the
            # light.
            self._end_epoch(f"the link to the board was lost: {self._describe_link_error()}")

    def _interrupt(self, reason: str) -> None:
        """Turn the light off until all is reported that was executed, if there is a reason."""
        if reason:
            self.pauses.interrupt(self._boards.board_s(), reason)
            self._handover.pause()

    def _watch_board(self) -> None:
        """End the epoch when a board has left its arming, or has a new fault. ABORT goes out in any case.

        It does not end what has ended; but a report that it has may be false.
        """
        seen, lost = self._seen_faults, self._boards.lost
        # A fault that is latched since before is no news: arming and stopping would otherwise end the epoch again at
        # each status.
        self._seen_faults = self._boards.list_faults()
        is_new_fault = any(
            fault and fault not in seen[stage : stage + 1] and (lost is None or stage != lost.stage)
            for stage, fault in enumerate(self._seen_faults)
        )
        if is_new_fault or (self._control is not None and not self._boards.has_arming):
            end = f"the board went to {self._boards.state} ({self._find_reason()})"
            self.go_dark(self._boards.describe_split() or end)

    def _find_reason(self) -> str:
        fault = self._boards.fault
        if not fault:
            return self._boards.last_event_reason
        cause = self._boards.likely_cause if fault == "LINK" else None
        return f"{fault}: {get_fault_hint(fault) if cause is None else cause.message}"

    @property
    def _is_armed(self) -> bool:
        return self._control is not None and self._boards.state in ARMED_STATES

    def _end_unattended(self) -> None:
        """Go dark when a plan that was allowed to finish without the web process has ended, and none has come back."""
        now_s = self._clock.now_s()
        if not self._is_armed or self._boards.has_points or self._clients.is_attended:
            self._attended_s = now_s
        elif now_s - self._attended_s > UNATTENDED_MAX_S:
            self.go_dark("nobody could disarm: the web process has ended")

    def _end_abandoned(self) -> None:
        """Go dark when the client that holds the arming has stopped to beat."""
        if self._control is not None and self._control.is_abandoned(self._clock.now_s()):
            self.go_dark(f"the client of {self._control.caller!r} that held the board armed does not beat")

    def _end_long_pause(self) -> None:
        if self.pauses.is_too_long:
            self.go_dark(f"the light was paused for {PAUSE_MAX_S:g} s")

    def close(self) -> None:
        """Send ABORT and close the port permanently."""
        self._boards.close()
