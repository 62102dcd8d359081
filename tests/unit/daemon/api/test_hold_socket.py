"""Messages from the web process to the link process that one client that holds an arming causes."""

import asyncio
from pathlib import Path
from typing import ClassVar

from optodrive.core.ipc import Message
from optodrive.daemon.api.client_sockets import CLIENT_LEFT, HoldSocket
from optodrive.daemon.api.daemon_client import LinkClient
from optodrive.daemon.api.peer import Peer


class Socket:
    """A WebSocket whose client sends two beats and leaves once it is told that the board is armed."""

    scope: ClassVar = {"subprotocols": []}

    def __init__(self):
        self.sent = []
        self._armed = asyncio.Event()
        self._messages = iter(["websocket.receive", "websocket.receive", "websocket.disconnect"])

    async def accept(self, subprotocol):
        pass

    async def receive(self):
        await self._armed.wait()
        return {"type": next(self._messages), "text": "beat"}

    async def send_text(self, text):
        self.sent.append(text)
        self._armed.set()


def test_the_end_of_a_client_that_holds_an_arming_releases_it():
    messages = []
    link = LinkClient(Peer("link", Path("nowhere")))

    async def call(message):
        messages.append(message)
        return Message("result", {"error": None})

    link.peer.send, link.peer.call = messages.append, call

    async def hold():
        socket = Socket()
        await HoldSocket(link, socket, "ann").run()
        return socket.sent

    assert asyncio.run(hold()) == ['{"status":"armed"}']
    assert [message.kind for message in messages] == ["arm", "hold", "hold", "release"]
    assert len({message.fields["arming"] for message in messages}) == 1
    assert messages[-1].fields["reason"] == CLIENT_LEFT
