"""planner.sock on the real link process: requests and replies, pushed state, ended plans, telemetry."""

import json
import pickle
import threading
import time
from functools import partial

import numpy as np
import pytest

from engine_rig import RiggedEngine
from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import OptodriveError
from optodrive.core.ipc import Message, MessageSocket
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.daemon.engine import planner_server
from optodrive.daemon.engine.plan_making import DryRunStart
from optodrive.daemon.engine.planner_server import PlannerServer
from optodrive.daemon.engine.telemetry_producer import TelemetryProducer
from optodrive.daemon.message_loop import LoopCommands
from optodrive.daemon.push import Push
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.state import PlannerState
from optodrive.daemon.responses.telemetry import EVENTS, PulseBatch
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli.sequence_file import encode_sequence
from rig import Board, config_text, wait_for


def build_frame(height_um=100.0, pixels=(17,), duration_s=1.0):
    target_m = np.zeros(437)
    target_m[list(pixels)] = height_um * 1e-6
    return FrameSequence((TactileFrame("f", 0.0, duration_s, target_m),))


def build_train(seconds):
    return FrameSequence((), (PulseTrain(200, 0.0, seconds, 0.01, 0.01, 1.0),))


class Web:
    """Client of planner.sock. received: all messages in order."""

    def __init__(self, path, engine):
        self.engine, self.received, self._read = engine, [], 0
        self.socket = MessageSocket.connect(path)
        self._ids = iter(range(1, 1000))

    def send(self, kind, payload=b"", **fields):
        self.socket.send(Message(kind, fields, payload))

    def request(self, kind, payload=b"", **fields):
        request_id = next(self._ids)
        self.send(kind, payload, id=request_id, **fields)
        return request_id

    def submit(self, sequence, epoch=None, streamed=False, fit="as_is"):
        fields = {"push": self.build_push(epoch, streamed, fit), "labels": {}, "parameters": {}}
        return self.request("submit", encode_sequence(sequence), **fields)

    def submit_body(self, body):
        return self.request("submit_body", body, push=self.build_push(None, True, "as_is"))

    def build_push(self, epoch, streamed, fit):
        epoch = self.engine.web.status["epoch"] if epoch is None else epoch
        push = Push("push", {"fit": fit}, time.monotonic(), epoch, "token", streamed, lists_pulses=not streamed)
        return push._asdict()

    def receive(self):
        self.socket.flush()
        self.received += self.socket.receive()
        return self.received

    def of_kind(self, kind):
        return [message for message in self.receive() if message.kind == kind]

    def result(self, request_id):
        def find():
            return [message for message in self.of_kind("result") if message.fields["id"] == request_id]

        return wait_for(find, "the result")[0]

    def report(self, request_id):
        message = self.result(request_id)
        assert message.fields["status"] in (200, 201), message
        return PlanReport.model_validate_json(message.payload)

    def problem(self, request_id):
        message = self.result(request_id)
        return message.fields["status"], json.loads(message.payload)["code"]


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("planner")
    board = Board(folder)
    config = folder / "engine.toml"
    config.write_text(config_text(board.port))
    engine = RiggedEngine(folder, load_config(config), board.port)
    server = PlannerServer(engine, folder / "planner.sock", MonotonicClock())
    engine.on_loop = server.publish_state
    engine.start()
    yield engine, folder / "planner.sock"
    engine.stop_loop()
    server.close()
    engine.stop_all()
    board.stop()


@pytest.fixture
def web(rig):
    """A client of an armed display. All plans end with the test."""
    engine, path = rig
    engine.arm().result()
    web = Web(path, engine)
    yield web
    web.socket.close()
    engine.stop().result()


def test_a_plan_is_submitted_reported_and_ends_with_the_state_before_each_reply(web):
    request = web.submit(build_frame())
    report = web.report(request)
    assert (report.status, report.planned, report.caller) == ("queued", 1, "token")
    audit = {"plan": report.plan, "pattern": "push", "pulses": 1, "plan_status": "queued"}
    assert web.result(request).fields["audit"] == audit
    kinds = [message.kind for message in web.received]
    states = [PlannerState.model_validate(message.fields) for message in web.of_kind("state")]
    before = states[kinds[: kinds.index("result")].count("state") - 1]
    assert report.plan in [plan.plan for plan in before.queue.plans]

    def find_done():
        found = web.report(web.request("get_plan", plan=report.plan, pulses=False))
        return found if found.has_ended else None

    done = wait_for(find_done, "the end")
    assert (done.status, done.executed, done.pulses) == ("done", 1, None)
    assert web.report(web.request("get_plan", plan=report.plan, pulses=True)).pulses.pixel == [17]
    assert not web.of_kind("ended")  # only streamed plans


def test_a_streamed_body_is_parsed_and_planned_with_its_labels(web):
    frame = {"show_at_s": 0, "duration_s": 9, "target_um": {"17": 100, "20": 50}}
    report = web.report(web.submit_body(json.dumps({"frames": [frame], "labels": {"trial": 7}}).encode()))
    assert (report.planned, report.labels) == (2, {"trial": 7})
    frame["target_um"]["437"] = 50
    assert web.problem(web.submit_body(json.dumps({"frames": [frame]}).encode())) == (422, "unknown_pixel")
    assert web.problem(web.submit_body(b"[" * 30_000)) == (422, "bad_json")


def test_errors_are_problems(web):
    assert web.problem(web.submit(build_frame(5000.0))) == (422, "target_unreachable")
    assert web.problem(web.submit(build_frame(), streamed=True, fit="even")) == (422, "bad_input")
    assert web.problem(web.submit(build_frame(), epoch=1)) == (409, "stopped")
    assert web.problem(web.request("get_plan", plan="p0", pulses=True)) == (404, "plan_not_found")
    assert web.problem(web.request("cancel", plan="p0")) == (404, "plan_not_found")


def test_streamed_plans_report_their_end(web):
    first = web.report(web.submit(build_frame(pixels=range(300), duration_s=10.0), streamed=True))
    wait_for(lambda: web.engine.get_plan(first.plan).executed >= 5, "a part of the frame")
    second = web.report(web.submit(build_frame(pixels=range(5), duration_s=10.0), streamed=True))
    wait_for(lambda: second.plan in [message.fields["plan"] for message in web.of_kind("ended")], "both ends")
    ended = {m.fields["plan"]: PlanReport.model_validate_json(m.payload) for m in web.of_kind("ended")}
    assert all(report.pulses is None for report in ended.values())
    assert ended.pop(second.plan).status == "done"
    assert first.plan in ended  # on a stalled computer its rest was a frame of its own, which ends like it
    assert {report.status for report in ended.values()} == {"superseded"}
    running = web.report(web.submit(build_frame(pixels=range(300), duration_s=10.0), streamed=True))
    wait_for(lambda: web.engine.get_plan(running.plan).executed >= 5, "a part of the frame")
    web.send("end_stream", epoch=web.engine.web.status["epoch"], caller="token")
    wait_for(lambda: web.engine.get_plan(running.plan).has_ended, "the end of the stream")
    assert web.engine.get_plan(running.plan).executed < 300


def test_dropped_requests_are_neither_planned_nor_answered(web, monkeypatch):
    hold = threading.Event()
    decode = planner_server.decode_sequence
    monkeypatch.setattr(planner_server, "decode_sequence", lambda body: hold.wait(10) and decode(body))
    kept, *dropped = [web.submit(build_frame()) for _ in range(4)]
    for request in dropped:
        web.send("drop", id=request)
    web.result(web.request("metrics"))  # the drops have arrived
    before = len(web.engine.build_planner_state().queue.plans)
    hold.set()
    web.report(kept)
    web.report(web.submit(build_frame()))
    assert len(web.engine.build_planner_state().queue.plans) == before + 2
    assert not [message for message in web.of_kind("result") if message.fields["id"] in dropped]


def test_the_requests_of_a_lost_connection_are_dropped(rig, web, monkeypatch):
    engine, path = rig
    hold = threading.Event()
    decode = planner_server.decode_sequence
    monkeypatch.setattr(planner_server, "decode_sequence", lambda body: hold.wait(10) and decode(body))
    other = Web(path, engine)
    other.submit(build_train(3.0))
    wait_for(lambda: engine.build_planner_state().planner.busy, "the request")
    other.socket.close()
    time.sleep(0.1)
    hold.set()
    web.report(web.submit(build_frame()))
    assert "push" in [plan.name for plan in engine.build_planner_state().queue.plans]
    assert all(plan.planned == 1 for plan in engine.build_planner_state().queue.plans[-1:])


def test_too_many_waiting_requests_are_refused(web, monkeypatch):
    hold = threading.Event()
    decode = planner_server.decode_sequence
    monkeypatch.setattr(planner_server, "decode_sequence", lambda body: hold.wait(10) and decode(body))
    requests = [web.submit(build_frame()) for _ in range(18)]
    assert web.problem(requests[-1]) == (503, "busy")
    hold.set()
    assert web.report(requests[-2]).status in ("queued", "running")


def test_a_snapshot_starts_a_dry_run(web):
    def look():
        start = pickle.loads(web.result(web.request("snapshot")).payload)
        assert isinstance(start, DryRunStart)
        assert start.starts_in_s > 0.0
        return start.starts_in_s < 0.1

    wait_for(look, "the end of the tests' earlier plans")


def test_a_report_that_cannot_be_encoded_is_answered_as_an_error(web, monkeypatch):
    """Or its caller would wait and never hear of it."""

    def encode(report):
        raise MemoryError

    plan = web.report(web.submit(build_train(0.1))).plan
    monkeypatch.setattr(planner_server, "iterate_json", encode)
    for request in (web.request("get_plan", plan=plan, pulses=True), web.submit(build_train(0.1))):
        answer = web.result(request)
        assert answer.fields["status"] == 500
        assert "MemoryError" in json.loads(answer.payload)["detail"]


def test_telemetry_is_sent_while_there_are_readers_and_pulses_once(web):
    plan = web.report(web.submit(build_train(0.4))).plan
    wait_for(lambda: web.engine.get_plan(plan).has_ended, "the end")
    assert not web.of_kind("telemetry")
    assert not web.of_kind("pulses")
    web.send("telemetry", readers=1, rate_hz=50.0)

    def executed_rows(client):
        batches = [message for message in client.of_kind("pulses") if message.fields["batch"] == "executed"]
        texts = [PulseBatch.model_validate_json(message.payload) for message in batches]
        return [row for batch in texts if batch.plan == plan for row in batch.row]

    wait_for(lambda: len(executed_rows(web)) >= 20, "the pulses from before")
    made = {"display", "budget", "fingers", "page"}
    wait_for(lambda: made <= {m.fields["event"] for m in web.of_kind("telemetry")}, "one of each")
    for message in web.of_kind("telemetry"):
        EVENTS[message.fields["event"]].model_validate_json(message.payload)
    second = Web(web.socket._connection.getpeername(), web.engine)
    second.send("telemetry", readers=2, rate_hz=30.0)
    wait_for(lambda: len(executed_rows(second)) >= 20, "the same pulses")
    for client in (web, second):
        assert sorted(executed_rows(client)) == list(range(20))
    second.socket.close()
    web.send("telemetry", readers=0, rate_hz=30.0)
    time.sleep(0.3)
    count = len(web.of_kind("telemetry"))
    time.sleep(0.3)
    assert len(web.of_kind("telemetry")) == count


def test_an_error_of_the_telemetry_is_raised_in_the_loop_which_ends_the_process(rig, monkeypatch):
    errors, commands = [], LoopCommands()
    producer = TelemetryProducer(rig[0], MonotonicClock(), pytest.fail, errors.append)
    monkeypatch.setattr(producer, "produce", lambda: np.zeros(1)[2])
    producer.start()
    wait_for(lambda: errors, "the error")
    commands.post(partial(planner_server._fail, errors[0]))
    with pytest.raises(OptodriveError, match="the telemetry failed: IndexError: index 2 is out of bounds"):
        commands.run_pending()
    commands.close()
