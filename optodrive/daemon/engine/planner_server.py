"""The planner process, and its server of planner.sock: requests of the web process, pushed state, telemetry.

It sends ended streamed plans, too.
"""

import pickle
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from math import inf
from pathlib import Path

from optodrive.core.child_process import BeatWriter, SupervisorGoneError
from optodrive.core.clock import Clock, MonotonicClock
from optodrive.core.errors import OptodriveError
from optodrive.core.ipc import Message, MessageSocket
from optodrive.core.json_model import iterate_json
from optodrive.core.processes import PLANNING, set_realtime_priority, use_usual_priority
from optodrive.core.types.fingers import FingerPlace
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.engine.plan_making import DryRunStart
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.plan_rest import ThermalMemory
from optodrive.daemon.engine.session_recording import start_session_recorder
from optodrive.daemon.engine.telemetry_producer import TelemetryProducer
from optodrive.daemon.log import open_daemon_log
from optodrive.daemon.message_loop import MessageServer
from optodrive.daemon.push import BuiltRequest, Push, build_request
from optodrive.daemon.responses.messages import RefreshReport
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.problem import build_error_problem, build_problem
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.link.board_setup import build_scales
from optodrive.link.service.remote_session import RemoteSession
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli.sequence_file import decode_sequence

STATE_PERIOD_S = 0.5
STATE_CHANGE_PERIOD_S = 0.02
"""Least time between two states, unless a reply follows: a streamed plan changes the state five times."""


@dataclass
class _Client:
    """State of a connection.

    requests: events of callers that wait, by id; readers: of its telemetry
    """

    requests: dict[int, tuple[threading.Event, "Future[PlanReport]"]] = field(default_factory=dict)
    readers: int = 0
    rate_hz: float = 1.0
    batch_number: int = 0


class PlannerServer:
    """Clients of the planner process. The engine's thread calls everything."""

    def __init__(self, engine: Engine, path: Path, clock: Clock) -> None:
        self._engine = engine
        self._clock = clock
        self._clients: dict[MessageSocket, _Client] = {}
        self._report_executor = ThreadPoolExecutor(1, "reports", use_usual_priority)
        self._state_key: object = None
        self._state_sent_s = -inf
        self._server = MessageServer(engine.message_loop, path, self._on_message, self._on_lost)
        self._telemetry = TelemetryProducer(
            engine,
            clock,
            lambda message: engine.commands.post(partial(self._send_telemetry, message)),
            lambda error: engine.commands.post(partial(_fail, error)),
        )
        self._telemetry.start()
        engine.add_plan_end_callback(lambda plan: engine.commands.post(partial(self._report_end, plan.record)))

    def close(self) -> None:
        """End the connections and the threads."""
        self._telemetry.close()
        self._report_executor.shutdown(wait=False, cancel_futures=True)
        self._server.close()

    # --- requests -----------------------------------------------------------------------------------------------

    def _on_message(self, connection: MessageSocket, message: Message) -> None:
        client = self._clients.setdefault(connection, _Client())
        fields = message.fields
        handlers: dict[str, Callable[[], object]] = {
            "submit": lambda: self._submit(connection, client, message),
            "submit_body": lambda: self._submit(connection, client, message),
            "drop": lambda: self._drop(client, fields["id"]),
            "get_plan": lambda: self._answer(
                connection, fields["id"], lambda: self._engine.get_plan(fields["plan"], fields["pulses"])
            ),
            "dim": lambda: self._dim(connection, fields["id"], fields["share"], fields["may_raise"]),
            "revoke": lambda: self._engine.revoke(fields["caller"]),
            "cancel": lambda: self._cancel(connection, fields["id"], fields["plan"]),
            "metrics": lambda: self._reply(connection, fields["id"], 200, self._engine.render_metrics().encode()),
            "snapshot": lambda: self._reply(connection, fields["id"], 200, build_dry_run_start(self._engine)),
            "fingers": lambda: self._engine.page.update_fingers(
                fields["at_s"], [FingerPlace(*place) for place in fields["places"]]
            ),
            "end_stream": lambda: self._engine.end_stream(fields["epoch"], fields["caller"]),
            "telemetry": lambda: self._set_readers(connection, client, fields["readers"], fields["rate_hz"]),
        }
        try:
            handlers[message.kind]()
        except OptodriveError as error:
            self._refuse(connection, fields.get("id"), error)

    def _on_lost(self, connection: MessageSocket) -> None:
        client = self._clients.pop(connection, _Client())
        for request_id in list(client.requests):
            self._drop(client, request_id)
        self._update_readers()

    def _submit(self, connection: MessageSocket, client: _Client, message: Message) -> None:
        request_id, push, caller_left = message.fields["id"], Push(**message.fields["push"]), threading.Event()
        future = self._engine.submit(partial(self._build, message, push.name), push, caller_left)
        client.requests[request_id] = caller_left, future

        def finish(done: "Future[PlanReport]") -> None:
            if done.cancelled():
                return
            answer = _encode(done.result, 201, is_read=not push.refreshes)  # in the planner's thread
            self._engine.commands.post(partial(self._finish, connection, client, request_id, push, *answer))

        future.add_done_callback(finish)

    def _build(self, message: Message, name: str) -> BuiltRequest:
        """Build the sequence of a push: that of a body, or one that the preview process has built."""
        if message.kind == "submit_body":
            return build_request(self._engine.display, "sequence", name, message.payload)
        return BuiltRequest(decode_sequence(message.payload), message.fields["labels"], message.fields["parameters"])

    def _finish(
        self,
        connection: MessageSocket,
        client: _Client,
        request_id: int,
        push: Push,
        status: int,
        payload: bytes,
        audit: dict[str, object],
    ) -> None:
        if client.requests.pop(request_id, None) is not None:
            self._reply(connection, request_id, status, payload, audit, is_explained=not push.refreshes)

    def _drop(self, client: _Client, request_id: int) -> None:
        """Forget a request: one that waits is not planned, and one that is being planned ends."""
        caller_left, future = client.requests.pop(request_id, (None, None))
        if caller_left is not None and future is not None:
            caller_left.set()
            future.cancel()

    def _answer(self, connection: MessageSocket, request_id: int, build: Callable[[], PlanReport]) -> None:
        """Build and encode a report in another thread, and reply."""

        def work() -> None:
            answer = _encode(build, 200)
            self._engine.commands.post(partial(self._reply, connection, request_id, *answer))

        self._report_executor.submit(work)

    def _cancel(self, connection: MessageSocket, request_id: int, plan: str) -> None:
        self._engine.cancel(plan).add_done_callback(
            lambda done: self._answer(connection, request_id, done.result)  # the future is done
        )

    def _dim(self, connection: MessageSocket, request_id: int, share: float, may_raise: bool) -> None:
        """Set the share of the power, unless the caller may only lower it. Raise InputError for a wrong one."""
        dimmer = self._engine.dimmer
        if share > dimmer.power_share and not may_raise:
            detail = f"only a token of role armer may raise the power above {dimmer.power_share:g} of full power"
            problem = build_problem(403, "insufficient_role", "Forbidden", detail, required_role="armer")
            self._reply(connection, request_id, problem.status, problem.to_json())
            return
        dimmer.set_share(share)
        self._reply(connection, request_id, 200, b"")

    def _refuse(self, connection: MessageSocket, request_id: int | None, error: OptodriveError) -> None:
        if request_id is not None:
            problem = build_error_problem(error)
            self._reply(connection, request_id, problem.status, problem.to_json())

    def _reply(
        self,
        connection: MessageSocket,
        request_id: int,
        status: int,
        payload: bytes,
        audit: dict[str, object] | None = None,
        is_explained: bool = True,
    ) -> None:
        """Send a result, after the state that explains it unless nobody looks at that."""
        if is_explained:
            self._publish_state(0.0)
        fields = {"id": request_id, "status": status, "audit": audit or {}}
        self._engine.message_loop.send(connection, Message("result", fields, payload))

    # --- pushed messages ----------------------------------------------------------------------------------------

    def publish_state(self) -> None:
        """Send the state to all clients if it has changed or is due. Call it in every loop iteration."""
        self._publish_state(STATE_CHANGE_PERIOD_S)

    def _publish_state(self, change_period_s: float) -> None:
        """Send the state if it has changed and the last one is that old, or if it is due."""
        age_s = self._clock.now_s() - self._state_sent_s
        if age_s < change_period_s:
            return
        key = self._engine.compute_state_key(), len(self._server.clients)
        if key == self._state_key and age_s < STATE_PERIOD_S:
            return
        self._state_key, self._state_sent_s = key, self._clock.now_s()
        self._server.broadcast(Message("state", self._engine.build_planner_state().model_dump(mode="json")))

    def _report_end(self, record: PlanRecord) -> None:
        if not record.streamed or record.refreshes:
            return
        self._publish_state(0.0)
        report = record.build_report(self._engine.board_s(), False, self._engine.read_clocks())
        self._server.broadcast(Message("ended", {"plan": record.plan_id}, report.model_dump_json().encode()))

    # --- telemetry ----------------------------------------------------------------------------------------------

    def _set_readers(self, connection: MessageSocket, client: _Client, readers: int, rate_hz: float) -> None:
        is_new = readers and not client.readers
        client.readers, client.rate_hz = readers, rate_hz
        self._update_readers()
        if is_new:
            client.batch_number = 0
            for message in self._telemetry.restart():
                self._send_batch(connection, client, message)

    def _update_readers(self) -> None:
        reading = [client for client in self._clients.values() if client.readers]
        self._telemetry.set_readers(len(reading), max((client.rate_hz for client in reading), default=1.0))

    def _send_telemetry(self, message: Message) -> None:
        for connection, client in list(self._clients.items()):
            if not client.readers:
                continue
            if message.kind == "pulses":
                self._send_batch(connection, client, message)
            else:
                self._engine.message_loop.send(connection, message)

    def _send_batch(self, connection: MessageSocket, client: _Client, message: Message) -> None:
        """Send a batch of pulses once."""
        number: int = message.fields["number"]
        if number > client.batch_number:
            client.batch_number = number
            self._engine.message_loop.send(connection, message)


def _fail(error: BaseException) -> None:
    """Raise the error of a thread in the loop, which ends the process and with it all light."""
    raise OptodriveError(f"the telemetry failed: {type(error).__name__}: {error}") from error


def _encode(
    get_report: Callable[[], PlanReport], status: int, is_read: bool = True
) -> tuple[int, bytes, dict[str, object]]:
    """Return status, JSON and audit fields of a report, or of the problem that kept it from being made or encoded.

    is_read: whether anybody reads the report; else what is left of it is a `RefreshReport`
    """
    try:
        report = get_report()
        audit: dict[str, object] = {
            "plan": report.plan,
            "pattern": report.name,
            "pulses": report.planned,
            "plan_status": report.status,
        }
        if not is_read:
            limited_by = report.summary.limited_by
            return status, RefreshReport(limited_by=limited_by).model_dump_json().encode(), audit
        return status, b"".join(iterate_json(report)), audit
    except OptodriveError as error:
        problem = build_error_problem(error)
    except Exception as error:
        problem = build_error_problem(OptodriveError(f"{type(error).__name__}: {error}"))
    return problem.status, problem.to_json(), {}


def run_planner(
    display: DisplayModel,
    folder: RuntimeFolder,
    beat: BeatWriter,
    session_path: Path | None,
    memory: ThermalMemory,
) -> None:
    """Plan and hand over until SIGTERM or the end of the supervisor.

    display: warm, see `warm_up`; session_path: new HDF5 file for a recording of every plan, instead of the configured
    one; memory: shared with earlier and later planner processes. Raise InputError if the recording cannot be started.
    """
    ending: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: ending.append(number))
    clock = MonotonicClock()
    with ExitStack() as exit_stack:
        log = open_daemon_log()
        exit_stack.callback(log.close)
        session = RemoteSession(build_scales(display.config), folder.link_socket, clock)
        engine = Engine(display, session, clock, memory)
        engine.on_warning = log.warn
        recorder = start_session_recorder(engine, session_path, log)
        if recorder is not None:
            exit_stack.callback(recorder.close)
        exit_stack.callback(engine.close)
        server = PlannerServer(engine, folder.planner_socket, clock)
        exit_stack.callback(server.close)

        engine.on_loop, engine.on_beat = server.publish_state, beat.beat
        engine.message_loop.watch(beat, beat.receive)
        beat.report_ready()
        set_realtime_priority(PLANNING)
        try:
            engine.run(lambda: bool(ending))
        except SupervisorGoneError:
            return


def build_dry_run_start(engine: Engine) -> bytes:
    """Return the pickled start of a dry run."""
    snapshot = engine.plan_queue.make_snapshot(streamed=False, planning_time_s=0.0)
    starts_in_s, dimmer = snapshot.start_s - engine.board_s(), engine.dimmer
    start = DryRunStart(snapshot.before, starts_in_s, dimmer.power_share, dimmer.lost_stage)
    return pickle.dumps(start, pickle.HIGHEST_PROTOCOL)
