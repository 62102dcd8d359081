"""Main function of the web process."""

import asyncio
import os
import signal
import time
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from fastapi import FastAPI

from optodrive.core.child_process import OUT_OF_MEMORY, BeatWriter, SupervisorGoneError
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.app import build_app
from optodrive.daemon.api.audit import AuditLog
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.reload_requests import RESULT, apply_reload
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.daemon.log import open_daemon_log
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.daemon.server.acceptor_client import AcceptorClient
from optodrive.daemon.server.listeners import describe_exposure
from optodrive.daemon.server.web_server import Server
from optodrive.device.config_sections import DaemonSection
from optodrive.planning.display_model import DisplayModel

BEAT_INTERVAL_S = 0.05
READY_TIMEOUT_S = 1.0
"""Time after which the server accepts callers and counts as ready, even if another process does not run."""
STATE_POLL_S = 0.005


def run_web(
    display: DisplayModel,
    folder: RuntimeFolder,
    beat: BeatWriter,
    tokens: Tokens,
    daemon: DaemonSection,
) -> None:
    """Serve the API until SIGTERM or the end of the supervisor.

    daemon: settings, whose reloaded keys may differ from the display's
    """
    with ExitStack() as exit_stack:
        log = open_daemon_log()
        exit_stack.callback(log.close)
        log.attach_to_root_logger()
        exposure = describe_exposure(daemon.host, daemon.hosts)
        if exposure is not None:
            log.warn(exposure)
        audit = AuditLog(Path(daemon.audit), log.warn) if daemon.audit else None
        if audit is not None:
            exit_stack.callback(audit.close)
        policy = AccessPolicy(tokens, daemon, audit)
        exit_stack.callback(policy.refusals.flush)
        acceptor = AcceptorClient(folder.acceptor_socket)
        process = WebProcess(DaemonClient(display, folder), acceptor, policy, beat, daemon)
        exit_stack.callback(process.receive_control)  # the last entries of the audit log
        signal.signal(signal.SIGTERM, lambda number, frame: process.end())
        process.server.run()


class WebProcess:
    """The server with its connections to the other processes and to the supervisor."""

    def __init__(
        self,
        client: DaemonClient,
        acceptor: AcceptorClient,
        policy: AccessPolicy,
        beat: BeatWriter,
        daemon: DaemonSection,
    ) -> None:
        self._client = client
        client.reloads.send = beat.send
        self._acceptor = acceptor
        acceptor.on_connected = self._beat_link  # the first caller may arm at once
        acceptor.on_lost = self._go_dark
        self._policy = policy
        self._beat = beat
        self._daemon = daemon
        self._revocations: list[asyncio.Task[None]] = []
        app = build_app(client, policy)
        app.router.lifespan_context = self._run_connections
        self.server = Server(app, acceptor, policy)

    def end(self) -> None:
        """Go dark, end all streams and let the server finish. Also called by a signal handler."""
        if self.server.loop is not None:
            with suppress(RuntimeError):  # after the loop's end
                # A signal handler runs between two bytecodes of any code: the loop's own sockets are used from the loop
                # only.
                self.server.loop.call_soon_threadsafe(self._go_dark)
        self._client.hub.close()
        self.server.should_exit = True

    @asynccontextmanager
    async def _run_connections(self, _app: FastAPI) -> AsyncIterator[None]:
        """Keep the connections and the beats while the server runs."""
        self._client.start()
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._on_loop_error)
        loop.add_reader(self._beat.fileno(), self.receive_control)
        beats = loop.create_task(self._send_beats())
        try:
            await self._wait_for_state()
            yield
        finally:
            beats.cancel()
            loop.remove_reader(self._beat.fileno())
            self._client.close()

    async def _wait_for_state(self) -> None:
        """Let callers wait until the first answer is true. Without link and planner the board is dark."""
        deadline_s = time.monotonic() + READY_TIMEOUT_S
        while not (self._client.knows_state or self.server.should_exit or time.monotonic() > deadline_s):
            await asyncio.sleep(STATE_POLL_S)

    def _on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """End the process if a callback had no memory: it would be called, and fail, again, and STOP would wait."""
        if isinstance(context.get("exception"), MemoryError):
            self._beat.report_failure(OUT_OF_MEMORY)
            # Not sys.exit, which would run callbacks and clean-up without memory.
            os._exit(1)
        loop.default_exception_handler(context)

    async def _send_beats(self) -> None:
        deadline_s, is_ready = time.monotonic() + READY_TIMEOUT_S, False
        while True:
            self._beat_link()
            self._beat.beat()
            is_complete = self._client.is_complete and self._acceptor.is_connected
            if not is_ready and self.server.started and (is_complete or time.monotonic() > deadline_s):
                is_ready = True
                self._beat.report_ready()
            await asyncio.sleep(BEAT_INTERVAL_S)

    def _beat_link(self) -> None:
        # Alive only with a living acceptor: a web process that no new caller reaches must not keep the light on.
        self._client.link.beat(alive=self._acceptor.check_beats())

    def _go_dark(self) -> None:
        """Stop, unless a plan may finish: soon no new caller can."""
        if self._daemon.on_web_loss == "dark":
            self._client.link.send_stop()

    def receive_control(self) -> None:
        """Carry out the supervisor's messages. End without a supervisor."""
        try:
            messages = self._beat.receive()
        except SupervisorGoneError:
            with suppress(RuntimeError):  # outside of the loop, at the end
                asyncio.get_running_loop().remove_reader(self._beat.fileno())
            self.end()
            return
        for fields in messages:
            self._carry_out(fields)

    def _carry_out(self, fields: dict[str, Any]) -> None:
        if fields["kind"] == "audit":
            self._record(fields["fields"])
        elif fields["kind"] == "reload":
            self._daemon, revoked = apply_reload(self._policy, self._daemon, fields)
            if revoked and self.server.loop is not None and self.server.loop.is_running():
                self._revoke(revoked)
            self._record(fields["fields"])
            self._beat.send({"kind": "reloaded", "id": fields["id"]})
        elif fields["kind"] == RESULT:
            self._client.reloads.on_result(fields)
        elif fields["kind"] == "end":
            self.end()

    def _revoke(self, tokens: tuple[Token, ...]) -> None:
        """End the light, then the requests and connections, of tokens that are no longer valid."""
        for token in tokens:
            # The light first, then the requests: ended in the other order, a push in between would still be accepted.
            self._client.revoke(token.name)
        tasks = self._policy.in_progress.revoke(tokens)
        tasks.append(asyncio.create_task(self.server.close_revoked(tokens)))
        self._revocations = [task for task in self._revocations if not task.done()] + tasks

    def _record(self, fields: dict[str, Any]) -> None:
        if self._policy.audit is not None:
            self._policy.audit.record(fields)
