"""The epoch of a streamed frame: that of the earliest time at which it may have arrived."""

import asyncio
import time
from pathlib import Path

import pytest

from optodrive.core.errors import NotReadyError
from optodrive.core.ipc import Message
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.live_stream import LiveStream
from optodrive.daemon.api.request_limits import ARRIVED_S, EARLIEST_S
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel

FOLDER = RuntimeFolder(Path("nowhere"), Path("nowhere/link.sock"), 0o600, Path("nowhere"))
BEFORE, AFTER = 5, 6
"""The epochs before and after a STOP."""


class Client:
    """The server's end of the WebSocket of a client that sends one frame and leaves when that is answered."""

    def __init__(self, times_s):
        self.scope = {"headers": []}
        self._messages = [{"type": "websocket.receive", "text": '{"target_um": {"0": 60}}', **times_s}]
        self._answered = asyncio.Event()

    async def accept(self, subprotocol):
        pass

    async def receive(self):
        if self._messages:
            return self._messages.pop()
        await self._answered.wait()
        return {"type": "websocket.disconnect"}

    async def send_text(self, text):
        self._answered.set()


@pytest.mark.parametrize(("waited", "epoch"), [(True, BEFORE), (False, AFTER)])
def test_a_frame_that_may_have_waited_since_before_a_stop_belongs_to_the_epoch_before(waited, epoch):
    async def stream():
        daemon = DaemonClient(DisplayModel.from_config(load_config("display-16")), FOLDER)
        pushed = []

        async def submit(sequence, push):
            pushed.append(push)
            raise NotReadyError("the planner is not part of this test")

        daemon.planner.submit = submit
        daemon.link.on_message(Message("command", {"epoch": BEFORE}))
        before_s = time.monotonic()
        daemon.link.on_message(Message("command", {"epoch": AFTER}))
        arrived_s = time.monotonic()
        client = Client({EARLIEST_S: before_s if waited else arrived_s, ARRIVED_S: arrived_s})
        await LiveStream(daemon, client, "trim", "ann").run()
        return arrived_s, pushed

    arrived_s, (push,) = asyncio.run(stream())
    assert push.epoch == epoch
    assert push.arrived_s == arrived_s  # from which the latency counts
