"""The daemon's process: engine up, web server up, and both down again, dark, whatever ends it."""

import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn

from optodrive.clock import MonotonicClock
from optodrive.config import Config
from optodrive.daemon.api import make_app
from optodrive.daemon.engine import Engine
from optodrive.daemon.token import make_token
from optodrive.errors import InputError, LinkError
from optodrive.pipeline import Display
from optodrive.transport.registry import make_transport

GRACE_S = 2


class _Server(uvicorn.Server):
    """Leaves signals to `run`: uvicorn would raise them again and end the process before the board is told."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield


def run(config: Config) -> None:
    """Serve until a signal; the board is told to stop on the way out, and goes dark by itself if that is not heard."""
    listener = _listen(config.daemon.host, config.daemon.port)
    port = listener.getsockname()[1]
    board = config.board
    engine = Engine(Display.of(config), make_transport(board.transport, board.port, board.baud), MonotonicClock())
    try:
        engine.start()
        token, path = make_token(port)
        server = _Server(
            uvicorn.Config(
                make_app(engine, token),
                log_level="warning",
                access_log=False,
                server_header=False,
                timeout_graceful_shutdown=GRACE_S,
                ws="websockets-sansio",
                ws_max_size=config.daemon.body_max_bytes,
            )
        )

        def leave(*_: object) -> None:
            engine.stop()  # dark first: the server may wait for callers that are slow to go
            server.should_exit = True

        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, leave)
        print(f"optodrive: {config.name} on http://{config.daemon.host}:{port}, token in {path}", flush=True)
        print(f"optodrive: board at {engine.link_name}, {engine.board_state}; arm with `optodrive arm`", flush=True)
        engine.on_failure = lambda: setattr(server, "should_exit", True)
        server.run(sockets=[listener])
        if engine.failure is not None:
            raise LinkError(f"the engine failed, the board was told to abort: {engine.failure!r}")
    finally:
        engine.close()
        listener.close()


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol named, asyncio turns Nagle's delay off for each caller: it costs an answer 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen()  # from the line that tells the address on, whoever calls is heard
    except OSError as error:
        listener.close()
        raise InputError("daemon.port", port, f"an address that is free on {host} ({error.strerror})") from None
    return listener
