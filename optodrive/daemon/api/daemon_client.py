"""The daemon's other processes as the web process sees them: link, planner and preview.

Every call to a process that does not run raises LinkError at once, which is answered with 503.
"""

import asyncio
import time
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from optodrive.core.ipc import Message
from optodrive.core.types.fingers import FingerPlace
from optodrive.daemon.api.peer import Peer
from optodrive.daemon.api.reload_requests import ReloadRequests
from optodrive.daemon.api.state_merge import merge_state
from optodrive.daemon.api.telemetry_hub import TelemetryHub
from optodrive.daemon.push import NO_LABELS, LabelValues, ParameterValues, Push
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.state import PlannerState, StateReport
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.link.service.control import PauseStatus
from optodrive.link.service.link_connection import NO_REQUEST, build_error
from optodrive.link.service.status import NO_EPOCH, ServiceStatus
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.group_state import CONNECTING
from optodrive.planning.display_model import DisplayModel

EPOCHS_MAX = 1000
ENDED_MAX = 1000
STREAMED_BODY_MAX_BYTES = 32_768
"""Largest body that the planner parses: a frame of 1,511 targets has 20 kB, and no such body takes over 10 ms."""


class LinkClient:
    """The link process: its status, epochs, and commands to the board."""

    def __init__(self, peer: Peer) -> None:
        self.status: ServiceStatus | None = None
        self.peer = peer
        self._epochs: deque[tuple[float, int]] = deque([(0.0, NO_EPOCH)], EPOCHS_MAX)
        self._held: dict[int, asyncio.Future[str]] = {}
        peer.on_connected = lambda: peer.send(Message("hello", {"role": "web"}))

    def on_message(self, message: Message) -> None:
        """Take a status or a result."""
        if message.kind == "status":
            self.status = ServiceStatus.from_fields(message.fields)
            self._end_armings(self.status.control, self.status.epoch_reason)
        elif message.kind == "result" and self.status is not None and "board" in message.fields:
            # A result comes before the next status, and its caller reads the state at once.
            board, pause = BoardView.from_dict(message.fields["board"]), PauseStatus(**message.fields["pause"])
            self.status = replace(self.status, board=board, pause=pause)
        if "epoch" in message.fields:
            self._record_epoch(message.fields["epoch"])

    def on_lost(self) -> None:
        """Take the end of the process."""
        self.status = None
        self._record_epoch(NO_EPOCH)
        self._end_armings(None, "the link process has ended")

    def _record_epoch(self, epoch: int) -> None:
        if epoch != self._epochs[-1][1]:
            self._epochs.append((time.monotonic(), epoch))

    def require_epoch_at(self, arrived_s: float) -> int:
        """Return the epoch at a monotonic time, or an older one. Raise LinkError while there is none."""
        if self._epochs[-1][1] == NO_EPOCH:
            raise self.peer.build_loss_error()
        # Older than kept counts as the oldest, which link refuses: never as a newer one.
        position = bisect_right(self._epochs, arrived_s, key=lambda entry: entry[0])
        return self._epochs[max(0, position - 1)][1]

    def beat(self, alive: bool) -> None:
        """Prove that the event loop runs. alive: whether a new caller could stop."""
        self.peer.send(Message("beat", {"alive": alive}))

    def send_stop(self) -> None:
        """Send STOP without waiting for its result."""
        self.peer.send(Message("stop", {"id": NO_REQUEST}))

    async def arm(self, caller: str, arming: int | None = None) -> None:
        """Arm as `command` does.

        caller: name of the token; arming: new number of an arming that needs beats
        """
        await self.command("arm", caller=caller, arming=arming or 0, hold=arming is not None)

    def hold(self, arming: int, age_s: float) -> None:
        """Prove that the client that holds an arming is there. age_s: time since it did."""
        self.peer.send(Message("hold", {"arming": arming, "age_s": age_s}))

    def release(self, arming: int, reason: str) -> None:
        """End an arming, if it still lasts. reason: for people, as the end of a sentence."""
        self._held.pop(arming, None)
        self.peer.send(Message("release", {"arming": arming, "reason": reason}))

    def watch_arming(self, arming: int) -> "asyncio.Future[str]":
        """Return the future of the reason for which an arming ends. `release` forgets it."""
        return self._held.setdefault(arming, asyncio.get_running_loop().create_future())

    def _end_armings(self, control: Mapping[str, Any] | None, reason: str) -> None:
        for arming, future in self._held.items():
            if (control is None or control["arming"] != arming) and not future.done():
                future.set_result(reason)

    async def command(self, kind: str, **fields: object) -> None:
        """Carry out `stop`, `arm`, `disarm`, `pause` or `resume`. Return when the board has done it.

        Raise the error of a refusal.
        """
        call = asyncio.ensure_future(self.peer.call(Message(kind, fields)))
        call.add_done_callback(lambda done: done.cancelled() or done.exception())  # retrieved if the caller has left
        # A caller that leaves ends its wait, and not the command.
        result = await asyncio.shield(call)
        if result.fields["error"] is not None:
            raise build_error(result.fields["error"])


class PlannerClient:
    """The planner process: its state, plans and telemetry."""

    def __init__(self, peer: Peer) -> None:
        self.state: PlannerState | None = None
        self.peer = peer
        self._ended: OrderedDict[str, PlanReport] = OrderedDict()
        self._waiting: dict[str, asyncio.Future[PlanReport]] = {}

    def on_message(self, message: Message) -> None:
        """Take the state or the end of a streamed plan."""
        if message.kind == "state":
            self.state = PlannerState.model_validate(message.fields)
        elif message.kind == "ended":
            plan, report = message.fields["plan"], PlanReport.model_validate_json(message.payload)
            future = self._waiting.pop(plan, None)
            if future is not None and not future.done():
                future.set_result(report)
                return
            self._ended[plan] = report
            while len(self._ended) > ENDED_MAX:
                self._ended.popitem(last=False)

    def on_lost(self) -> None:
        """Take the end of the process, and of all its plans."""
        self.state = None
        self._ended.clear()
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(self.peer.build_loss_error())
        self._waiting.clear()

    async def submit(
        self,
        sequence: bytes,
        push: Push,
        labels: LabelValues = NO_LABELS,
        parameters: ParameterValues = NO_LABELS,
    ) -> Message:
        """Plan an encoded sequence and return the result.

        labels: of the caller; parameters: of the pattern, all
        """
        fields = {"push": push._asdict(), "labels": dict(labels), "parameters": dict(parameters)}
        return await self.peer.call(Message("submit", fields, sequence))

    async def submit_body(self, body: bytes, push: Push) -> Message:
        """Parse and plan a streamed FRAMES.json and return the result."""
        return await self.peer.call(Message("submit_body", {"push": push._asdict()}, body))

    async def wait_for_end(self, plan: str) -> PlanReport:
        """Return the report of a streamed plan once it has ended."""
        report = self._ended.pop(plan, None)
        if report is not None:
            return report
        future = self._waiting.setdefault(plan, asyncio.get_running_loop().create_future())
        try:
            return await future
        finally:
            self._waiting.pop(plan, None)

    async def call(self, kind: str, **fields: object) -> Message:
        """Send a request without payload and return the result."""
        return await self.peer.call(Message(kind, fields))

    def end_stream(self, epoch: int, caller: str) -> None:
        """Drop the unsent rest of a stream's last plan."""
        self.peer.send(Message("end_stream", {"epoch": epoch, "caller": caller}))


class DaemonClient:
    """The three processes, the state of the daemon, and the reloads that its supervisor carries out.

    fingers_callbacks: called with the time of arrival of new places of fingers
    """

    def __init__(self, display: DisplayModel, folder: RuntimeFolder) -> None:
        self.display = display
        self.link = LinkClient(Peer("link", folder.link_socket, drops=False))
        self.planner = PlannerClient(Peer("planner", folder.planner_socket))
        self.preview = Peer("preview", folder.preview_socket)
        self.reloads = ReloadRequests()
        self.hub = TelemetryHub()
        self.fingers_callbacks: set[Callable[[float], None]] = set()
        self._state: StateReport | None = None
        self._state_json = b""
        link, planner = self.link.peer, self.planner.peer
        link.on_message, planner.on_message = self._on_link_message, self._on_planner_message
        link.on_lost, planner.on_lost = self._on_link_lost, self._on_planner_lost
        planner.on_connected = self._send_readers
        self.hub.on_readers = lambda readers, rate_hz: self._on_readers()

    def start(self) -> None:
        """Connect to all, in the running event loop."""
        for peer in (self.link.peer, self.planner.peer, self.preview):
            peer.start()

    def close(self) -> None:
        """End all event streams and connections."""
        self.hub.close()
        for peer in (self.link.peer, self.planner.peer, self.preview):
            peer.close()

    @property
    def knows_state(self) -> bool:
        """Whether the planner has reported its state, and the link process that the board is there or absent."""
        link = self.link.status
        return link is not None and link.link_error_code != CONNECTING and self.planner.state is not None

    @property
    def is_complete(self) -> bool:
        """Whether the state is known and previews can be requested."""
        return self.knows_state and self.preview.is_connected

    def build_state(self) -> StateReport:
        """Report the last known state, which is built once per change."""
        if self._state is None:
            pixels = len(self.display.layout)
            self._state = merge_state(self.display.config, pixels, self.link.status, self.planner.state)
        return self._state

    def encode_state(self) -> bytes:
        """Encode the state as JSON, once per change."""
        if not self._state_json:
            self._state_json = self.build_state().model_dump_json().encode()
        return self._state_json

    async def plan_dry_run(self, source: str, body: bytes, push: Push) -> Message:
        """Plan a body in the preview process from the planner's present state, and return the result."""
        snapshot = await self.planner.call("snapshot")
        if snapshot.fields["status"] != 200:
            return snapshot
        fields = {"source": source, "push": push._asdict(), "snapshot_bytes": len(snapshot.payload)}
        return await self.preview.call(Message("dry_run", fields, snapshot.payload + body))

    async def push(self, source: str, body: bytes, push: Push) -> Message:
        """Build the sequence of a body, then plan it. Return the result of the step that refuses it, or of the plan.

        The planner itself parses a small streamed body, because it is there three hand-overs earlier.
        """
        # A larger one would hold the planner's thread, and with it other streams.
        if push.streamed and len(body) <= STREAMED_BODY_MAX_BYTES:
            return await self.planner.submit_body(body, push)
        built = await self.preview.call(Message("build", {"source": source, "push": push._asdict()}, body))
        if built.fields["status"] != 200:
            return built
        return await self.planner.submit(built.payload, push, built.fields["labels"], built.fields["parameters"])

    def send_fingers(self, places: Sequence[FingerPlace], at_s: float, arrived_s: float) -> None:
        """Report the fingers that a tracker saw at a monotonic time, to the planner and to the standing pages."""
        self.planner.peer.send(Message("fingers", {"at_s": at_s, "places": [list(place) for place in places]}))
        for callback in self.fingers_callbacks:
            callback(arrived_s)

    def revoke(self, caller: str) -> None:
        """End the plans of a caller whose token is no longer valid, and the arming if it has armed the board."""
        for peer in (self.link.peer, self.planner.peer):
            peer.send(Message("revoke", {"caller": caller}))

    def _on_readers(self) -> None:
        """Tell the planner process of the readers of the telemetry, and a new reader of the state."""
        self._send_readers()
        self._publish_state()

    def _send_readers(self) -> None:
        readers, rate_hz = self.hub.readers
        self.planner.peer.send(Message("telemetry", {"readers": readers, "rate_hz": rate_hz}))

    def _on_link_message(self, message: Message) -> None:
        self.link.on_message(message)
        self._publish_state()

    def _on_planner_message(self, message: Message) -> None:
        if message.kind in ("telemetry", "pulses"):
            self.hub.receive(message)
            return
        self.planner.on_message(message)
        if message.kind == "state":
            self._publish_state()

    def _on_link_lost(self) -> None:
        self.link.on_lost()
        self._publish_state()

    def _on_planner_lost(self) -> None:
        self.planner.on_lost()
        self._publish_state()

    def _publish_state(self) -> None:
        # Built when it is read next.
        self._state, self._state_json = None, b""
        if self.hub.readers[0]:
            self.hub.publish_state(self.build_state())
