"""The daemon's process: engine up, web server up, and both down again, dark, whatever ends it."""

import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import uvicorn

from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import LinkError
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.engine.session_notes import recorder_of
from optodrive.daemon.log import daemon_log
from optodrive.daemon.notify import Notifier
from optodrive.daemon.reload import Reloading
from optodrive.daemon.web.access_policy import Door
from optodrive.daemon.web.api import make_app
from optodrive.daemon.web.audit import Audit
from optodrive.daemon.web.listeners import tcp_listener, unix_listener
from optodrive.daemon.web.tokens import daemon_tokens
from optodrive.daemon.web.web_server import Server
from optodrive.device.config import Config
from optodrive.link.transport.link_capture import TapeWriter
from optodrive.link.transport.recorded import RecordedTransport
from optodrive.link.transport.registry import transport_maker
from optodrive.planning.pipeline import Display

GRACE_S = 2


def run(
    config: Config,
    record: Path | None = None,
    again: Callable[[], Config] | None = None,
    record_session: Path | None = None,
) -> None:
    """Serve until a signal; the board is told to stop on the way out, and goes dark by itself if that is not heard.

    record: note every byte on the link in this file, which must be new. again: reads the configuration anew; a service
    manager's SIGHUP asks for that, any other ends the daemon, for its terminal has gone.
    record_session: note every plan in this HDF5 file, which must be new; else as the configuration says
    """
    with ExitStack() as ending:  # closed from the last to the first: the engine before all others
        log = daemon_log()
        ending.callback(log.close)
        make_transport = transport_maker(config.board)
        listeners = [tcp_listener(config.daemon.host, config.daemon.port)]
        ending.callback(listeners[0].close)
        port = listeners[0].getsockname()[1]
        clock, transport = MonotonicClock(), make_transport()
        if record is not None:
            transport = RecordedTransport(transport, TapeWriter(record, clock.now_s(), log.warn), clock)
        notifier = Notifier(clock)
        ending.callback(notifier.close)
        engine = Engine(Display.of(config), transport, clock)
        engine.say = log.warn
        engine.on_turn = notifier.alive
        recorder = recorder_of(engine, record_session, log)
        if recorder is not None:
            ending.callback(recorder.close)
        audit = Audit(Path(config.daemon.audit), log.warn) if config.daemon.audit else None
        if audit is not None:
            ending.callback(audit.close)
            ending.callback(audit.note, {"event": "ended"})
        unix = Path(config.daemon.socket) if config.daemon.socket else None
        if unix is not None:
            listeners.append(unix_listener(unix))
            ending.callback(_unlink, unix)
            ending.callback(listeners[1].close)
        tokens, path = daemon_tokens(config.daemon.tokens, port)
        if not config.daemon.tokens:  # made for this run
            ending.callback(_unlink, path)
        ending.callback(engine.close)
        engine.start()
        door = Door(tokens, config.daemon, audit)
        app = make_app(engine, door)
        server = Server(
            uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,  # a caller does not say by itself from where it calls
                timeout_graceful_shutdown=GRACE_S,
                ws="websockets-sansio",
                ws_max_size=config.daemon.body_max_bytes,
            )
        )
        log.take_logging()

        def leave(*_: object) -> None:
            engine.stop()  # dark first: the server may wait for callers that are slow to go
            app.state.telemetry.close()
            notifier.tell("STOPPING=1")
            server.should_exit = True

        reloading = Reloading(config, again, engine, door, server, notifier, log)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, leave)
        if notifier.listened_to and again is not None:
            signal.signal(signal.SIGHUP, reloading.asked_for)
        also = f" and {unix}" if unix else ""
        print(f"optodrive: {config.name} on http://{config.daemon.host}:{port}{also}, token in {path}", flush=True)
        if sys.stdout.isatty():  # a secret: to whoever sits there, never to a log
            secret = tokens.strongest.secret
            print(f"optodrive: the page, for you alone: http://{config.daemon.host}:{port}/#token={secret}", flush=True)
        print(f"optodrive: board at {engine.link_name}, {engine.board_state}; arm with `optodrive arm`", flush=True)
        if audit is not None:
            audit.note({"event": "started", "display": config.name})
        engine.on_failure = lambda: setattr(server, "should_exit", True)
        server.on_ready = lambda: notifier.tell("READY=1", f"STATUS=board at {engine.link_name}")
        server.run(sockets=listeners)
        if engine.failure is not None:
            raise LinkError(f"the engine failed, the board was told to abort: {engine.failure!r}")


def _unlink(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
