"""Main function of the daemon: opens the sockets, tokens and runtime folder, and runs the supervisor."""

import ctypes
import os
import socket
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optodrive.core.child_process import BeatWriter, execute_module, fork_with_beat
from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import OptodriveError, escape_unprintable
from optodrive.core.ipc import open_unix_listener
from optodrive.core.processes import set_nice, settle_memory
from optodrive.daemon.api.reload_requests import REQUEST, RESULT
from optodrive.daemon.api.tokens import PERMISSIONS, ROLES, Tokens, load_daemon_tokens
from optodrive.daemon.log import DaemonLog, Notifier, open_daemon_log
from optodrive.daemon.reload import ConfigReloader, ReloadResult
from optodrive.daemon.responses.problem import build_error_problem
from optodrive.daemon.responses.state import ReloadReport
from optodrive.daemon.runtime_folder import SHARED_LINK_MODE, RuntimeFolder, open_runtime_folder
from optodrive.daemon.server.listeners import BACKLOG, build_local_url, open_tcp_listener
from optodrive.daemon.supervisor.child import Child
from optodrive.daemon.supervisor.supervisor import LinkView, Supervisor
from optodrive.device.config import Config
from optodrive.device.config_sections import DaemonSection
from optodrive.link.board_setup import build_link_settings, build_port_settings
from optodrive.link.transport.registry import find_transport_factory

if TYPE_CHECKING:
    from optodrive.planning.display_model import DisplayModel


class ReloadHandler:
    """Handles one reload after the other."""

    def __init__(self, reloader: ConfigReloader, supervisor: Supervisor, notifier: Notifier, log: DaemonLog) -> None:
        self._reloader = reloader
        self._supervisor = supervisor
        self._notifier = notifier
        self._log = log
        self._number = 0
        self._applied: ReloadResult | None = None
        self._callers: list[str] = []

    def request(self) -> None:
        """Read the configuration and send the changes to the web process."""
        self._notifier.notify_reloading()
        try:
            result = self._reloader.reload(self._supervisor.link_view.board_state)
        except OptodriveError as error:
            self._refuse(error)
            return
        except Exception as error:  # of no file that was foreseen: this process must go on, for it watches the others
            self._refuse(OptodriveError(escape_unprintable(f"{type(error).__name__}: {error}")))
            return
        self._number += 1
        self._applied = result
        if not self._supervisor.send_reload(result.build_web_message(self._number)):
            # The web process gets it when it starts; a caller who has lost the right may have armed the board.
            if result.revoked:
                self._supervisor.link_view.stop()
            self._finish(result)

    def _refuse(self, error: OptodriveError) -> None:
        self._log.write(f"not reloaded, nothing changed: {error}", "err", EVENT="reload-refused")
        self._supervisor.record_audit({"event": "reload_refused", "reason": str(error)})
        self._notifier.send("READY=1", f"STATUS=not reloaded: {error}")
        self._answer({"problem": build_error_problem(error).to_dict()})

    def on_web_message(self, fields: dict[str, Any]) -> None:
        """Begin the reload that a caller requests. End one when the web process has applied it."""
        if fields.get("kind") == REQUEST:
            self._callers.append(fields["id"])
            self.request()
        elif fields.get("kind") == "reloaded" and fields.get("id") == self._number and self._applied is not None:
            self._finish(self._applied)

    def _finish(self, result: ReloadResult) -> None:
        self._applied = None
        self._log.write(result.line, "notice", EVENT="reloaded")
        self._notifier.send("READY=1", f"STATUS={result.line}")
        revoked = [token.name for token in result.revoked]
        report = ReloadReport(message=result.line, applied=result.reloaded, waiting=result.waiting, revoked=revoked)
        self._answer({"report": report.model_dump()})

    def _answer(self, fields: dict[str, Any]) -> None:
        """Send the outcome to the callers who have requested a reload since the last one."""
        callers, self._callers = self._callers, []
        for request_id in callers:
            self._supervisor.send_to_web({"kind": RESULT, "id": request_id, **fields})


NICE = -10
"""Priority of the daemon's processes, as the systemd unit sets it; less than real time, which link has."""
M_ARENA_MAX = -8
LINK_MODULE = "optodrive.link.service.process"


def run(
    config: Config,
    capture_path: Path | None = None,
    read_config: Callable[[], Config] | None = None,
    session_path: Path | None = None,
) -> None:
    """Serve until a signal arrives, then stop the board and end every process.

    capture_path: new file for a capture of the link
    read_config: reads the configuration again on SIGHUP of a service manager; any other SIGHUP ends the daemon, because
    its terminal has closed
    session_path: new HDF5 file for a recording of every plan, instead of the configured one
    """
    with ExitStack() as exit_stack:  # closes in reverse order: the processes first
        log = open_daemon_log()
        exit_stack.callback(log.close)
        for stage in config.list_stage_configs():
            find_transport_factory(build_port_settings(stage))  # refuses a laser DAC
        set_nice(NICE)  # every process inherits it, link while it still loads
        clock = MonotonicClock()
        notifier = Notifier(clock)
        exit_stack.callback(notifier.close)
        listeners = [open_tcp_listener(config.daemon.host, config.daemon.port)]
        exit_stack.callback(listeners[0].close)
        port = listeners[0].getsockname()[1]
        unix = Path(config.daemon.socket) if config.daemon.socket else None
        if unix is not None:  # before the runtime folder: who holds it owns the link socket beside it
            listeners.append(open_unix_listener(unix, SHARED_LINK_MODE, BACKLOG, "daemon.socket"))
            exit_stack.callback(_unlink, unix)
            exit_stack.callback(listeners[1].close)
        folder = open_runtime_folder(port, unix)
        exit_stack.callback(folder.remove)
        is_new = bool(config.daemon.tokens) and not os.path.lexists(config.daemon.tokens)
        tokens, tokens_path = load_daemon_tokens(config.daemon.tokens, port)
        if not config.daemon.tokens:  # generated for this run
            exit_stack.callback(_unlink, tokens_path)
        link_view = LinkView(folder.link_socket, clock)
        link = Child("link", _build_link_start(config, folder, capture_path), clock)
        supervisor = Supervisor(link, link_view, notifier, log, clock)
        exit_stack.callback(supervisor.close)
        supervisor.install_signal_handlers()
        supervisor.start_link()  # it connects to the board while this process loads what the others need
        reloader = ConfigReloader(config, tokens, config.model_copy if read_config is None else read_config)
        starts = _build_starts(_load_display(config), folder, listeners, reloader, session_path)
        # After all is loaded and before the first fork: forks share what is not touched later.
        _prepare_memory()
        handler = ReloadHandler(reloader, supervisor, notifier, log)
        supervisor.on_web_message = handler.on_web_message
        if notifier.is_enabled and read_config is not None:
            supervisor.on_reload = handler.request
        # Web last: when it answers, planner, preview and acceptor are there.
        *others, web = (Child(name, start, clock) for name, start in starts.items())
        if supervisor.start_others(others, web):
            address = build_local_url(config.daemon.host, port)
            _announce(config, address, unix, tokens, tokens_path, is_new)
            supervisor.on_board_seen = partial(_announce_board, address=address)
            supervisor.record_audit({"event": "started", "display": config.name})
            supervisor.serve()


def _build_link_start(
    config: Config, folder: RuntimeFolder, capture_path: Path | None
) -> Callable[[socket.socket, int], int]:
    def start(channel: socket.socket, number: int) -> int:
        if number == 1:  # a disk that is full later must not keep the process from starting again
            settings = build_link_settings(config, folder.link_socket, folder.link_socket_mode, capture_path)
            folder.link_settings.write_text(settings.to_json(), encoding="utf-8")
        descriptor = str(channel.fileno())
        arguments = ("--settings", str(folder.link_settings), "--supervisor", descriptor)
        return execute_module(LINK_MODULE, arguments, [channel.fileno()])

    return start


def _load_display(config: Config) -> "DisplayModel":
    """Load the display model that the other processes need, so that they share its memory."""
    from optodrive.core.kernels import release_compiler
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.pipeline import warm_up

    display = DisplayModel.from_config(config)
    warm_up(display)
    release_compiler()
    return display


def _prepare_memory() -> None:
    """Let forks of this process share its memory for as long as they can, and keep little of their own free."""
    settle_memory()
    libc = ctypes.CDLL(None)
    libc.malloc_trim(0)
    libc.mallopt(M_ARENA_MAX, 1)  # by default, memory that one thread has freed is of no use to another


def _build_starts(
    display: "DisplayModel",
    folder: RuntimeFolder,
    listeners: list[socket.socket],
    reloader: ConfigReloader,
    session_path: Path | None,
) -> dict[str, Callable[[socket.socket, int], int]]:
    """Return how each forked process starts, by its name."""
    from optodrive.daemon.engine.plan_rest import ThermalMemory
    from optodrive.daemon.engine.planner_server import run_planner
    from optodrive.daemon.preview.process import run_preview
    from optodrive.daemon.server.acceptor import run_acceptor
    from optodrive.daemon.server.web_process import run_web

    # In the supervisor, which outlives its planners: a new one plans from the heat that the killed one has left.
    memory = ThermalMemory()
    # Only the acceptor keeps the listening sockets: with a second holder, callers would be accepted by nobody after its
    # death.
    kept = {"acceptor": [listener.fileno() for listener in listeners]}
    targets: dict[str, Callable[[BeatWriter, int], None]] = {
        "planner": lambda beat, number: run_planner(display, folder, beat, number_path(session_path, number), memory),
        "preview": lambda beat, number: run_preview(display, folder, beat),
        "acceptor": lambda beat, number: run_acceptor(folder, beat, listeners, reloader.tokens, reloader.config.daemon),
        "web": lambda beat, number: run_web(display, folder, beat, reloader.tokens, reloader.config.daemon),
    }

    def start(name: str, channel: socket.socket, number: int) -> int:
        return fork_with_beat(
            lambda beat: targets[name](beat, number), f"opto-{name}", channel.fileno(), kept.get(name, ())
        )

    return {name: partial(start, name) for name in targets}


def number_path(path: Path | None, number: int) -> Path | None:
    """Return the path of a recording for a start of its process, because a recording never replaces a file."""
    return path if path is None or number == 1 else path.with_stem(f"{path.stem}-{number}")


def _announce(config: Config, address: str, unix: Path | None, tokens: Tokens, tokens_path: Path, is_new: bool) -> None:
    """Print the addresses and the tokens. is_new: whether the configured file did not exist."""
    socket_text = f" and {unix}" if unix else ""
    roles = ", ".join(f"{role} {PERMISSIONS[role]}" for role in ROLES if any(each.role == role for each in tokens.all))
    tokens_text = f"a token per role, created in {tokens_path}" if is_new else f"tokens in {tokens_path}"
    print(f"optodrive: {config.name} on {address}{socket_text}, {tokens_text}: {roles}", flush=True)
    if sys.stdout.isatty():  # a secret: only on a terminal, never in a log
        print(f"optodrive: personal link to the page: {address}/#token={tokens.highest_role.secret}", flush=True)


def _announce_board(link_view: LinkView, address: str) -> None:
    """Print the state of the board, or that it is awaited. address: of the daemon, which the default one needs not."""
    default = DaemonSection()
    url = "" if address == f"http://{default.host}:{default.port}" else f" --url {address}"
    port = link_view.status.port
    if link_view.status.connected:
        print(f"optodrive: board at {port}, {link_view.board_state}; arm with `optodrive arm{url}`", flush=True)
    else:
        print(f"optodrive: waiting for the board at {port}", flush=True)


def _unlink(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
