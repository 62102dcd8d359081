"""Requests in progress by token, so that revoking a token ends them at once."""

import asyncio
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Literal

from optodrive.daemon.api.problem_response import send_problem
from optodrive.daemon.api.request_limits import Message, Receive, Send
from optodrive.daemon.api.tokens import Token
from optodrive.daemon.responses.problem import Problem, build_problem

POLICY_VIOLATION = 1008
EVENT_STREAM = b"text/event-stream"


def build_revoked_problem(token: Token) -> Problem:
    """Build the answer to a request whose token was revoked meanwhile."""
    return build_problem(401, "token_revoked", "Not authorised", f"the token {token.name!r} was revoked")


class RequestInProgress:
    """Input and output of a request.

    status: of its response, None before that; 101 for an open WebSocket
    """

    def __init__(self, kind: Literal["http", "websocket"], receive: Receive, send: Send) -> None:
        self.status: int | None = None
        self.is_revoked = False
        self._kind = kind
        self._receive = receive
        self._send = send
        self._is_event_stream = False

    async def receive(self) -> Message:
        """Return the next message, the end of the connection once the token is revoked."""
        message = await self._receive()
        return {"type": f"{self._kind}.disconnect"} if self.is_revoked else message

    async def send(self, message: Message) -> None:
        """Send a message, unless the token is revoked."""
        if self.is_revoked:
            return
        if message["type"].endswith("response.start"):
            self.status = message["status"]
            self._is_event_stream = any(
                name == b"content-type" and value.startswith(EVENT_STREAM) for name, value in message["headers"]
            )
        elif message["type"] == "websocket.accept":
            self.status = 101
        await self._send(message)

    def revoke(self) -> bool:
        """End the input and output of the application. Return False for a response that is being sent, which may end.

        A stream of events has no end of its own.
        """
        self.is_revoked = self._kind == "websocket" or self.status is None or self._is_event_stream
        return self.is_revoked

    async def send_end(self, problem: Problem) -> None:
        """Send the end of a revoked request, with one line."""
        if self.status is None:
            self.status = problem.status
            await send_problem(self._send, problem, "http" if self._kind == "http" else "websocket.http")
        elif self._kind == "websocket":
            await self._send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": problem.detail})
        else:
            await self._send({"type": "http.response.body", "body": f": {problem.detail}\n\n".encode()})


class RequestsInProgress:
    """The requests in progress. STOP is not among them: it is never ended."""

    def __init__(self) -> None:
        self._requests: dict[RequestInProgress, Token] = {}

    @contextmanager
    def track(self, request: RequestInProgress, token: Token) -> Iterator[None]:
        """Track a request while it is served."""
        self._requests[request] = token
        try:
            yield
        finally:
            del self._requests[request]

    def revoke(self, tokens: Iterable[Token]) -> list[asyncio.Task[None]]:
        """End the requests of some tokens at once. Return the tasks that say so to their clients."""
        revoked = set(tokens)
        return [
            asyncio.create_task(request.send_end(build_revoked_problem(token)))
            for request, token in self._requests.items()
            if token in revoked and request.revoke()
        ]
