"""Reloads: requests of callers, and the supervisor's message on changed tokens or settings, as the processes apply it.

The web process passes a request to the supervisor, which reads the files, as for SIGHUP.
"""

import asyncio
import secrets
from collections.abc import Callable
from typing import Any

from optodrive.core.errors import NotReadyError
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.daemon.responses.problem import Problem
from optodrive.daemon.responses.state import ReloadReport
from optodrive.device.config_sections import DaemonSection

TIMEOUT_S = 30.0
REQUEST, RESULT = "reload_request", "reload_result"
"""Kinds of the messages to and from the supervisor."""


class ReloadRequests:
    """The requests that the supervisor has not answered. send: sends it a message, once there is a channel."""

    def __init__(self) -> None:
        self.send: Callable[[dict[str, Any]], None] = lambda fields: None
        self._waiting: dict[str, asyncio.Future[ReloadReport | Problem]] = {}

    async def request(self) -> ReloadReport | Problem:
        """Request a reload and return its effect, or why nothing was changed. Raise NotReadyError without an answer."""
        request_id = secrets.token_hex(8)
        future: asyncio.Future[ReloadReport | Problem] = asyncio.get_running_loop().create_future()
        self._waiting[request_id] = future
        self.send({"kind": REQUEST, "id": request_id})
        try:
            async with asyncio.timeout(TIMEOUT_S):
                return await future
        except TimeoutError:
            raise NotReadyError(f"the supervisor has not answered within {TIMEOUT_S:g} s") from None
        finally:
            del self._waiting[request_id]

    def on_result(self, fields: dict[str, Any]) -> None:
        """Take the supervisor's answer to a request."""
        future = self._waiting.get(fields["id"])
        if future is None or future.done():
            return
        if "problem" in fields:
            future.set_result(Problem.model_validate(fields["problem"]))
        else:
            future.set_result(ReloadReport.model_validate(fields["report"]))


def apply_reload(
    policy: AccessPolicy, daemon: DaemonSection, fields: dict[str, Any]
) -> tuple[DaemonSection, tuple[Token, ...]]:
    """Apply a reload to the policy. Return the changed settings and the revoked tokens. fields: of the message."""
    daemon = daemon.model_copy(update=fields["daemon"] | {"hosts": tuple(fields["daemon"]["hosts"])})
    return daemon, policy.update(Tokens(Token(*entry) for entry in fields["tokens"]), daemon)
