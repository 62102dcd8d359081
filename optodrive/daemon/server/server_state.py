"""State that the web server shares with the protocols of its connections."""

import asyncio

import uvicorn.server

from optodrive.daemon.server.connections import Connections
from optodrive.daemon.server.stop_first_selector import StopFirstSelector


class ServerState(uvicorn.server.ServerState):
    """uvicorn's state with the table of open connections."""

    def __init__(self, clients: Connections, selector: StopFirstSelector) -> None:
        super().__init__()
        self.clients = clients
        self.selector = selector

    def pop_arrival_s(self, transport: asyncio.BaseTransport) -> float:
        """Return the monotonic time at which the input of a connection arrived that was just read."""
        return self.selector.pop_arrival_s(transport.get_extra_info("socket").fileno())

    def forget(self, transport: asyncio.Transport) -> None:
        """Remove a connection that is about to be closed."""
        self.clients.remove(transport)
        sock = transport.get_extra_info("socket")
        if sock is not None:
            self.selector.remove_client(sock.fileno())
