"""Frames of a stream that may be old: they are refused, and newer ones shown."""

import asyncio
import json
from types import SimpleNamespace

import pytest

from optodrive.daemon.api import live_stream
from optodrive.daemon.api.live_stream import FRAME_AGE_MAX_S, LiveStream
from optodrive.daemon.api.request_limits import ARRIVED_S, EARLIEST_S

FRAME = '{"target_um": {"1": 100}}'


class Client:
    """The daemon's end of a WebSocket whose client has sent one frame of each age, and its planner."""

    display = SimpleNamespace(layout=range(16))
    link = SimpleNamespace(require_epoch_at=lambda earliest_s: 1)

    def __init__(self, ages_s):
        self._ages_s = list(ages_s)
        self.answers, self.planned = [], []
        self.planner, self.scope = self, {"subprotocols": []}

    async def accept(self, subprotocol):
        pass

    async def receive(self):
        await asyncio.sleep(0)
        if not self._ages_s:
            for _ in range(20):  # until the planner has had its turn
                await asyncio.sleep(0)
            return {"type": "websocket.disconnect"}
        now_s = asyncio.get_running_loop().time()
        return {"type": "websocket.receive", "text": FRAME, ARRIVED_S: now_s, EARLIEST_S: now_s - self._ages_s.pop(0)}

    async def send_text(self, text):
        self.answers.append(json.loads(text))

    async def submit(self, sequence, push):
        self.planned.append(push.name)
        problem = json.dumps({"type": "about:blank", "title": "t", "status": 409, "detail": "d", "code": "not_ready"})
        return SimpleNamespace(fields={"status": 409}, payload=problem.encode())


def stream(ages_s):
    """Stream frames that may have waited for these times. Return details of refusals, and names of planned frames."""
    client = Client(ages_s)
    asyncio.run(LiveStream(client, client, "trim", "ann").run())
    return [answer["problem"]["detail"] for answer in client.answers], client.planned


def test_frames_of_a_backlog_are_refused_and_the_next_one_is_planned():
    refused, planned = stream([FRAME_AGE_MAX_S + 100.0] * 50 + [0.0])
    assert planned == ["frame 0"]
    assert len(refused) == 51
    assert "expected at most 2 s" in refused[0]


def test_without_the_bound_a_backlog_is_planned(monkeypatch):
    """Mutant."""
    monkeypatch.setattr(live_stream, "FRAME_AGE_MAX_S", float("inf"))
    _, planned = stream([FRAME_AGE_MAX_S + 100.0] * 50)
    assert planned


@pytest.mark.parametrize("age_s", [0.0, 0.5 * FRAME_AGE_MAX_S])
def test_a_frame_that_waited_for_a_moment_is_planned(age_s):
    assert stream([age_s])[1] == ["frame 0"]
