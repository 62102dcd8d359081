"""The link process: python -m optodrive.link.service.process --settings FILE --supervisor DESCRIPTOR.

It serves its socket and the board's port in one thread, and ends dark with its supervisor. SIGUSR1 is STOP, SIGTERM
ends it.
"""

import argparse
import itertools
import os
import select
import signal
import socket
import struct
import sys
import threading
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from optodrive.core.child_process import OUT_OF_MEMORY, BeatWriter, SupervisorGoneError, die_with_parent
from optodrive.core.clock import Clock, MonotonicClock
from optodrive.core.errors import InputError, OptodriveError
from optodrive.core.ipc import MESSAGE_MAX_BYTES, IpcError, MessageSocket, encode_message, open_unix_listener
from optodrive.core.processes import LIGHT, set_realtime_priority, settle_memory
from optodrive.link.service.link_service import LinkService
from optodrive.link.service.settings import BoardSettings, LinkSettings
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.base import Transport, guard_opening
from optodrive.link.transport.link_capture import CapturingTransport, LinkCaptureWriter
from optodrive.link.transport.registry import find_transport_factory
from optodrive.link.transport.threaded_transport import ThreadedTransport

CLIENTS_MAX = 32
"""Beyond this number, the operator who has been connected longest is dropped: a new one can always stop."""
ACCEPTED_MAX = 8
"""Connections accepted per iteration of the loop."""
BACKLOG = 128
OUT_MAX_BYTES = 8_000_000
OPERATOR_MESSAGE_MAX_BYTES = 4096
_CREDENTIALS = struct.Struct("3i")
"""Process, user and group of a peer."""


class ClientSockets:
    """Listening socket and connected clients."""

    def __init__(self, path: Path, mode: int, service: LinkService) -> None:
        self._path = path
        self._service = service
        self._numbers = itertools.count(1)
        self._sockets: dict[int, MessageSocket] = {}
        self._trusted: set[int] = set()
        self._listener = open_unix_listener(path, mode, BACKLOG, "link socket")
        self._listener.setblocking(False)

    def register(self, poll: select.poll) -> None:
        """Register all descriptors for the loop's next wait."""
        poll.register(self._listener, select.POLLIN)
        for client in self._sockets.values():
            poll.register(client, select.POLLIN | (select.POLLOUT if client.wants_write else 0))

    def process(self, ready: set[int]) -> None:
        """Serve the clients whose descriptors are ready, the planner with its long messages last."""
        ready_numbers = [number for number, client in self._sockets.items() if client.fileno() in ready]
        # A full frame is many kilobytes: STOP of another client must not wait for its parsing.
        for number in sorted(ready_numbers, key=lambda number: number == self._service.planner):
            self._serve(number)
        if self._listener.fileno() in ready:
            for _ in range(ACCEPTED_MAX):
                if not self._accept():
                    break

    def _serve(self, number: int) -> None:
        client = self._sockets[number]
        try:
            if client.wants_write:
                client.flush()
            for message in client.receive():
                self._service.on_message(number, message, number in self._trusted)
        except IpcError:
            self._drop(number)

    def _accept(self) -> bool:
        """Accept a client. Return False if none waits."""
        try:
            connection, _ = self._listener.accept()
        except OSError:  # none, it has left, or there is no descriptor
            return False
        if len(self._sockets) >= CLIENTS_MAX:
            self._drop_oldest_operator()
        # Numbers are never reused: a late message for a client that left reaches nobody.
        number, is_trusted = next(self._numbers), _read_user(connection) == os.geteuid()
        if is_trusted:
            self._trusted.add(number)
        # Every user in the group may open this socket to stop; none may fill this process's memory.
        max_bytes = MESSAGE_MAX_BYTES if is_trusted else OPERATOR_MESSAGE_MAX_BYTES
        self._sockets[number] = MessageSocket(connection, max_bytes, OUT_MAX_BYTES)
        return True

    def _drop_oldest_operator(self) -> None:
        observers = self._service.list_observers()
        for number in self._sockets:
            if number not in observers:
                self._drop(number)
                return

    def _drop(self, number: int) -> None:
        # A killed process ends here, for the kernel closes its socket: the light goes off at once, and no beat is
        # waited for. A process that hangs is found by its beats.
        self._sockets.pop(number).close()
        self._trusted.discard(number)
        self._service.on_client_lost(number)

    def deliver(self) -> None:
        """Send the service's messages. A client that does not read them is dropped."""
        for clients, message in self._service.pop_outgoing():
            data = encode_message(message)
            for number in clients:
                self._send(number, data)

    def _send(self, number: int, data: bytes) -> None:
        client = self._sockets.get(number)
        if client is None:
            return
        try:
            client.send_bytes(data)
        except IpcError:
            self._drop(number)

    def close(self) -> None:
        """Close all connections and remove the socket's path."""
        with suppress(OSError):
            self._path.unlink()
        self._listener.close()
        for client in self._sockets.values():
            client.close()


def _read_user(connection: socket.socket) -> int:
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(credentials)[1])


CAPTURES_MAX = 1000


class PortOpener:
    """Opens a port in a thread, because a driver, or the start of a simulated board, may block for seconds."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    def __call__(self) -> bool:
        """Return whether the port is open, False while it needs more time. Raise the error of a failure."""
        if self._thread is None:
            self._error = None
            thread = threading.Thread(target=self._open, name="open-port", daemon=True)
            with guard_opening(self._transport.name):  # there may be no room for a thread
                thread.start()
            self._thread = thread
        if self._thread.is_alive():
            return False
        self._thread = None
        if self._error is not None:
            raise self._error
        return True

    def _open(self) -> None:
        try:
            self._transport.open()
        except Exception as error:  # raised in the loop's thread
            self._error = error


class LinkProcess:
    """Loop over the ports, the clients, the supervisor and signals."""

    def __init__(
        self, settings: LinkSettings, transports: Sequence[Transport], clock: Clock, supervisor: BeatWriter
    ) -> None:
        boards = build_board_group(settings, transports, clock)
        # Later than every epoch of an earlier link process, which began at most once per microsecond.
        first_epoch = int(clock.now_s() * 1e6)
        self._service = LinkService(boards, clock, settings.on_web_loss, first_epoch)
        self._transports = transports
        self._supervisor = supervisor
        self._clients = ClientSockets(settings.socket_path, settings.socket_mode, self._service)
        self._wakeup, self._wakeup_write = socket.socketpair()
        self._ending = self._stop_requested = False

    def install_signals(self) -> None:
        """Let SIGUSR1 stop and SIGTERM end. Ignore the terminal's signals, which the supervisor handles."""
        self._wakeup.setblocking(False)
        self._wakeup_write.setblocking(False)
        # A signal that arrives between the flag's test and poll() would otherwise wait for the next descriptor.
        signal.set_wakeup_fd(self._wakeup_write.fileno(), warn_on_full_buffer=False)
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGUSR1, self._on_signal)
        for number in (signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)

    def _on_signal(self, number: int, frame: object) -> None:
        if number == signal.SIGUSR1:
            self._stop_requested = True
        else:
            self._ending = True

    def run(self) -> None:
        """Serve until SIGTERM or the end of the supervisor."""
        self._supervisor.report_ready()
        while not self._ending:
            try:
                self._run_once()
            except SupervisorGoneError:
                return

    def _run_once(self) -> None:
        poll = select.poll()
        ports = [port for transport in self._transports if (port := transport.fileno()) is not None]
        for descriptor in (self._supervisor.fileno(), self._wakeup.fileno(), *ports):
            poll.register(descriptor, select.POLLIN)
        self._clients.register(poll)
        ready = {descriptor for descriptor, _ in poll.poll(self._service.compute_wait_s() * 1e3)}
        if self._wakeup.fileno() in ready:
            with suppress(BlockingIOError):
                self._wakeup.recv(4096)
        # Before the clients: a push in this turn's messages is then of an epoch that has ended.
        if self._stop_requested:
            self._stop_requested = False
            self._service.go_dark("ended by SIGUSR1")
        # Then their commands, then the board: a command leaves in the write of the same turn.
        self._clients.process(ready)
        self._service.step()
        self._clients.deliver()
        # Last: a beat says that a whole turn was done.
        self._supervisor.beat()
        if self._supervisor.fileno() in ready:
            self._supervisor.receive()

    def close(self) -> None:
        """Send ABORT to the boards and close everything."""
        self._service.close()
        self._clients.close()
        signal.set_wakeup_fd(-1)
        self._wakeup.close()
        self._wakeup_write.close()


def open_capture(path: Path, clock: Clock, supervisor: BeatWriter) -> LinkCaptureWriter:
    """Open a capture at the path, or with a number after a restart. Raise InputError if it cannot be written."""

    def warn(line: str) -> None:
        supervisor.send({"kind": "warning", "message": line})

    for number in range(1, CAPTURES_MAX):
        numbered = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        if not numbered.exists():
            return LinkCaptureWriter(numbered, clock.now_s(), warn)
    raise InputError("--capture", str(path), "a name that is free: nothing is overwritten")


def build_transport(settings: LinkSettings, board: BoardSettings, clock: Clock, supervisor: BeatWriter) -> Transport:
    """Return the unopened transport to a board. The capture of one of several has the stage in its name."""
    transport = ThreadedTransport(find_transport_factory(board.port)())
    path = settings.capture_path
    if path is None:
        return transport
    path = path.with_stem(f"{path.stem}-{board.stage}") if board.stage else path
    return CapturingTransport(transport, open_capture(path, clock, supervisor), clock)


def build_board_group(settings: LinkSettings, transports: Sequence[Transport], clock: Clock) -> BoardGroup:
    """Build the sessions with the boards of all stages."""
    pairs, has_several = zip(transports, settings.boards, strict=True), len(transports) > 1
    sessions = [BoardSession(transport, clock, board.requirements, has_several) for transport, board in pairs]
    openers = [PortOpener(transport) for transport in transports]
    names = [board.stage for board in settings.boards]
    return BoardGroup(sessions, clock, openers, names, settings.skew_max_s, settings.on_stage_loss)


def read_settings(path: Path) -> LinkSettings:
    """Read the settings that the supervisor wrote. Raise InputError if that is impossible."""
    try:
        return LinkSettings.from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError("--settings", str(path), f"the link process's settings ({error})") from None


def main(arguments: list[str] | None = None) -> int:
    """Run the link process and return its exit status."""
    parser = argparse.ArgumentParser(prog="optodrive.link.service.process", description="Link process of the daemon.")
    parser.add_argument("--settings", type=Path, required=True, help="file of the settings, JSON")
    parser.add_argument("--supervisor", type=int, required=True, help="descriptor of the supervisor's channel")
    options = parser.parse_args(arguments)
    die_with_parent(signal.SIGTERM)  # besides the end of file on its channel
    supervisor = BeatWriter(options.supervisor)
    with ExitStack() as exit_stack:
        exit_stack.callback(supervisor.close)
        try:
            settings, clock = read_settings(options.settings), MonotonicClock()
            transports = [build_transport(settings, board, clock, supervisor) for board in settings.boards]
            process = LinkProcess(settings, transports, clock, supervisor)
        except OptodriveError as error:
            supervisor.report_failure(str(error), error.exit_status)
            return error.exit_status
        except OSError as error:  # of its socket, or of the folder of a simulated board
            supervisor.report_failure(f"the link process cannot start: {error}")
            return 1
        # On every way out: ABORT to the boards, then the ports are closed.
        exit_stack.callback(process.close)
        process.install_signals()
        # Before real time: page faults and garbage of the start must not fall into a lease.
        settle_memory()
        set_realtime_priority(LIGHT)
        try:
            process.run()
        except MemoryError:
            supervisor.report_failure(OUT_OF_MEMORY)
            return 1
        except BaseException as error:
            supervisor.report_failure(f"the link process failed: {error!r}")
            raise
    return 0


if __name__ == "__main__":
    sys.exit(main())
