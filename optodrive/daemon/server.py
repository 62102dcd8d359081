"""Main function of the daemon process: starts engine and web server, and stops both with the gate off."""

import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import LinkError
from optodrive.daemon.log import open_daemon_log
from optodrive.daemon.notify import Notifier
from optodrive.daemon.one_process.engine import Engine
from optodrive.daemon.one_process.session_recording import start_session_recorder
from optodrive.daemon.reload import ConfigReloader
from optodrive.daemon.web.access_policy import AccessPolicy
from optodrive.daemon.web.api import build_app
from optodrive.daemon.web.audit import AuditLog
from optodrive.daemon.web.listeners import describe_exposure, open_tcp_listener, open_unix_listener
from optodrive.daemon.web.tokens import load_daemon_tokens
from optodrive.daemon.web.web_server import Server
from optodrive.device.config import Config
from optodrive.link.board_setup import build_port_settings
from optodrive.link.transport.capturing_transport import CapturingTransport
from optodrive.link.transport.link_capture import LinkCaptureWriter
from optodrive.link.transport.registry import find_transport_factory
from optodrive.planning.display_model import DisplayModel


def run(
    config: Config,
    capture_path: Path | None = None,
    read_config: Callable[[], Config] | None = None,
    session_path: Path | None = None,
) -> None:
    """Serve until a signal arrives. Then abort the board, whose lease turns the gate off if it does not receive that.

    capture_path: new file for a capture of the link
    read_config: reads the configuration again on SIGHUP of a service manager; any other SIGHUP ends the daemon, because
    its terminal has closed
    session_path: new HDF5 file for a recording of every plan, instead of the configured one
    """
    with ExitStack() as exit_stack:  # closes in reverse order: the engine first
        log = open_daemon_log()
        exit_stack.callback(log.close)
        make_transport = find_transport_factory(build_port_settings(config.board))
        listeners = [open_tcp_listener(config.daemon.host, config.daemon.port)]
        exit_stack.callback(listeners[0].close)
        port = listeners[0].getsockname()[1]
        clock, transport = MonotonicClock(), make_transport()
        if capture_path is not None:
            transport = CapturingTransport(transport, LinkCaptureWriter(capture_path, clock.now_s(), log.warn), clock)
        notifier = Notifier(clock)
        exit_stack.callback(notifier.close)
        engine = Engine(DisplayModel.from_config(config), transport, clock)
        engine.on_warning = log.warn
        engine.on_loop = notifier.feed_watchdog
        recorder = start_session_recorder(engine, session_path, log)
        if recorder is not None:
            exit_stack.callback(recorder.close)
        audit = AuditLog(Path(config.daemon.audit), log.warn) if config.daemon.audit else None
        if audit is not None:
            exit_stack.callback(audit.close)
            exit_stack.callback(audit.record, {"event": "ended"})
        unix = Path(config.daemon.socket) if config.daemon.socket else None
        if unix is not None:
            listeners.append(open_unix_listener(unix))
            exit_stack.callback(_unlink, unix)
            exit_stack.callback(listeners[1].close)
        tokens, path = load_daemon_tokens(config.daemon.tokens, port)
        if not config.daemon.tokens:  # generated for this run
            exit_stack.callback(_unlink, path)
        exit_stack.callback(engine.close)
        engine.start()
        access_policy = AccessPolicy(tokens, config.daemon, audit)
        exit_stack.callback(access_policy.refusals.flush)
        exposure = describe_exposure(config.daemon.host)
        if exposure is not None:
            log.warn(exposure)
        app = build_app(engine, access_policy)  # type: ignore[arg-type]
        server = Server(app)
        log.attach_to_root_logger()

        def shut_down(*_: object) -> None:
            engine.stop()  # gate off first, because the server may wait for slow clients
            app.state.telemetry.close()
            notifier.send("STOPPING=1")
            server.should_exit = True

        reloader = ConfigReloader(config, read_config, engine, access_policy, server, notifier, log)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, shut_down)
        if notifier.is_enabled and read_config is not None:
            signal.signal(signal.SIGHUP, reloader.request_reload)
        socket_text = f" and {unix}" if unix else ""
        print(
            f"optodrive: {config.name} on http://{config.daemon.host}:{port}{socket_text}, token in {path}", flush=True
        )
        if sys.stdout.isatty():  # a secret: only on a terminal, never in a log
            secret = tokens.highest_role.secret
            print(
                f"optodrive: personal link to the page: http://{config.daemon.host}:{port}/#token={secret}", flush=True
            )
        print(f"optodrive: board at {engine.link_name}, {engine.board_state}; arm with `optodrive arm`", flush=True)
        if audit is not None:
            audit.record({"event": "started", "display": config.name})
        engine.on_failure = lambda: setattr(server, "should_exit", True)
        server.on_ready = lambda: notifier.send("READY=1", f"STATUS=board at {engine.link_name}")
        server.run(sockets=listeners)
        if engine.failure is not None:
            raise LinkError(f"the engine failed and aborted the board: {engine.failure!r}")


def _unlink(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
