"""Frames that stand outlive a refresh for which the planner was too busy, and no other refusal."""

import asyncio
import json
from types import SimpleNamespace

import pytest

from optodrive.core.errors import BusyError, LinkError, NotReadyError, StoppedError
from optodrive.daemon.api import live_stream
from optodrive.daemon.api.live_stream import StandingStream
from optodrive.daemon.api.request_limits import ARRIVED_S, EARLIEST_S
from optodrive.daemon.responses.messages import RefreshReport
from optodrive.daemon.responses.problem import build_error_problem
from planner_rig import PlannerRig, build_frame

PLANNED, BUSY = None, BusyError("too many requests wait: 8 before this one; try again later")


@pytest.fixture
def report(monkeypatch):
    """The report of a plan, as the planner encodes it."""
    rig = PlannerRig(monkeypatch).ready()
    return rig.submit(build_frame(60.0), rig.remote.epoch, streamed=True).result().model_dump_json().encode()


class Client:
    """The daemon's end of a WebSocket whose client sends frames, and its planner.

    outcomes: of the first plans of each frame, by its name; those after them succeed
    send_after: number of submissions before which each frame is sent; end_after: submissions that the client awaits
    """

    display = SimpleNamespace(layout=range(16))
    link = SimpleNamespace(require_epoch_at=lambda earliest_s: 1)

    def __init__(self, report, outcomes, send_after=(0,), end_after=6, caps=()):
        self._caps = list(caps)
        self._report, self._outcomes = report, {name: list(errors) for name, errors in outcomes.items()}
        self._send_after, self._end_after = list(send_after), end_after
        self.submitted, self.answers, self.ended_streams = [], [], 0
        self._changed = asyncio.Condition()
        self.planner, self.scope, self.fingers_callbacks = self, {"subprotocols": []}, set()

    async def accept(self, subprotocol):
        pass

    async def receive(self):
        await_count = self._send_after.pop(0) if self._send_after else None
        async with self._changed:
            if await_count is None:
                await self._changed.wait_for(lambda: self._is_refused or len(self.submitted) >= self._end_after)
                return {"type": "websocket.disconnect"}
            await self._changed.wait_for(lambda: len(self.submitted) >= await_count)
        now_s = asyncio.get_running_loop().time()
        text = '{"target_um": {"1": 100}}'
        return {"type": "websocket.receive", "text": text, ARRIVED_S: now_s, EARLIEST_S: now_s}

    @property
    def _is_refused(self):
        """Whether the first frame has ended: with the client of a frame that is gone there is nothing to await."""
        return ("refused", 0) in [(answer["status"], answer["frame"]) for answer in self.answers]

    async def send_text(self, text):
        async with self._changed:
            self.answers.append(json.loads(text))
            self._changed.notify_all()

    async def submit(self, sequence, push):
        async with self._changed:
            self.submitted.append(push.name)
            self._changed.notify_all()
        outcomes = self._outcomes.get(push.name)
        error = outcomes.pop(0) if outcomes else PLANNED
        if error is PLANNED:
            limited_by = self._caps.pop(0) if self._caps and push.refreshes else []
            refreshed = RefreshReport(limited_by=limited_by).model_dump_json().encode()
            return SimpleNamespace(fields={"status": 201}, payload=refreshed if push.refreshes else self._report)
        if isinstance(error, LinkError):
            raise error
        problem = build_error_problem(error)
        return SimpleNamespace(fields={"status": problem.status}, payload=problem.to_json())

    def end_stream(self, epoch, caller):
        self.ended_streams += 1


def stand(report, outcomes, **options):
    """Stream frames that stand. Return the client, and the status and the number of each answer."""

    async def run():
        client = Client(report, outcomes, **options)
        await StandingStream(client, client, "trim", "ann", False).run()
        return client

    client = asyncio.run(run())
    return client, [(answer["status"], answer["frame"]) for answer in client.answers]


def test_a_frame_outlives_refreshes_for_which_the_planner_was_too_busy(report):
    client, answers = stand(report, {"frame 0": [PLANNED, BUSY, BUSY, PLANNED, BUSY]})
    assert set(client.submitted) == {"frame 0"}
    assert len(client.submitted) >= 6
    assert answers == [("planned", 0)]
    assert client.ended_streams == 1


def test_without_another_try_a_busy_planner_would_end_it(report, monkeypatch):
    """Mutant."""
    monkeypatch.setattr(live_stream, "TRIED_AGAIN", ())
    client, answers = stand(report, {"frame 0": [PLANNED, BUSY]})
    assert client.submitted == ["frame 0"] * 2
    assert answers == [("planned", 0), ("refused", 0)]


@pytest.mark.parametrize("error", [StoppedError("stopped"), NotReadyError("not armed"), LinkError("no planner")])
def test_any_other_refusal_of_a_refresh_ends_it(report, error):
    client, answers = stand(report, {"frame 0": [PLANNED, error]})
    assert client.submitted == ["frame 0"] * 2
    assert answers == [("planned", 0), ("refused", 0)]
    assert client.ended_streams == 0


def test_a_new_frame_that_is_refused_leaves_the_older_one(report):
    client, answers = stand(report, {"frame 1": [BUSY]}, send_after=(0, 2), end_after=8)
    assert answers == [("planned", 0), ("refused", 1)]
    assert client.submitted.count("frame 1") == 1
    assert client.submitted[-1] == "frame 0"


def test_the_client_is_told_which_caps_take_light_from_a_frame_when_they_change(report, monkeypatch):
    monkeypatch.setattr(live_stream, "CAPS_PERIOD_S", 0.0)  # each refresh is told by itself
    caps = [[], ["display_mean_power"], ["display_mean_power"], ["touch_temperature"], [], []]
    client, answers = stand(report, {}, end_after=8, caps=caps)
    assert answers == [("planned", 0)] * 4
    assert [answer["limited_by"] for answer in client.answers] == [
        [],
        ["display_mean_power"],
        ["touch_temperature"],
        [],
    ]
