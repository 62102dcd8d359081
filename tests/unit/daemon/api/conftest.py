"""Application without the other processes of the daemon, for tests of routes."""

import asyncio
import json
from pathlib import Path

import httpx
import pytest

from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.app import build_app
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.tokens import ROLES, Token, Tokens
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.device.config_file import load_config
from optodrive.device.config_sections import DaemonSection
from optodrive.planning.display_model import DisplayModel


def build_application():
    """Build the application of the smallest display, with one token per role, whose secret is the role's name."""
    display = DisplayModel.from_config(load_config("display-16"))
    folder = RuntimeFolder(Path("nowhere"), Path("nowhere/link.sock"), 0o600, Path("nowhere"))
    policy = AccessPolicy(Tokens(Token(role, role, role) for role in ROLES), DaemonSection())
    return build_app(DaemonClient(display, folder), policy)


@pytest.fixture(scope="session")
def app():
    return build_application()


@pytest.fixture
def own_app():
    """An application of the test's own, which it may change."""
    return build_application()


@pytest.fixture
def send(app):
    """Function that sends one request to the application with the token of a role and returns the response."""

    def send(method, path, role="armer", **request):
        async def exchange():
            transport = httpx.ASGITransport(app, client=("127.0.0.1", 1))
            async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
                return await client.request(method, path, **request)

        headers = {} if role is None else {"Authorization": f"Bearer {role}"}
        request["headers"] = headers | request.get("headers", {})
        return asyncio.run(exchange())

    return send


PARAMETERS = {"{plan_id}": "p1", "{name}": "pixel", "{name:path}": "index.html"}


@pytest.fixture
def ask(app):
    """Function that sends one request, or the handshake of a WebSocket, to a route. It returns status and problem."""

    def ask(key, query="", body=b"", role="armer", to=app, **headers):
        method, path = key.split(" ")
        for name, value in PARAMETERS.items():
            path = path.replace(name, value)
        is_socket = method == "WEBSOCKET"
        received = [{"type": "websocket.connect"} if is_socket else {"type": "http.request", "body": body}]
        sent = []
        stated = {"host": "localhost", "authorization": role and f"Bearer {role}"}
        stated |= {"content-length": str(len(body)) if body else None} | headers

        async def receive():
            return received.pop(0) if received else {"type": "websocket.disconnect" if is_socket else "http.disconnect"}

        async def send(message):
            sent.append(message)

        scope = {
            "type": "websocket" if is_socket else "http",
            "path": path,
            "raw_path": path.encode(),
            "root_path": "",
            "query_string": query.encode(),
            "headers": [(name.encode(), value.encode()) for name, value in stated.items() if value is not None],
            "client": ("127.0.0.1", 1),
            "extensions": {"websocket.http.response": {}},
            **({} if is_socket else {"method": method}),
        }
        asyncio.run(to(scope, receive, send))
        status = next((message["status"] for message in sent if "status" in message), None)
        text = b"".join(message.get("body", b"") for message in sent if message["type"].endswith("response.body"))
        return status, json.loads(text) if text.startswith(b'{"type"') else None

    return ask
