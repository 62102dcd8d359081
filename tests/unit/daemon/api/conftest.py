"""Application without the other processes of the daemon, for tests of routes."""

import asyncio
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


@pytest.fixture(scope="session")
def app():
    """Application of the smallest display, with one token per role, whose secret is the role's name."""
    display = DisplayModel.from_config(load_config("display-16"))
    folder = RuntimeFolder(Path("nowhere"), Path("nowhere/link.sock"), 0o600, Path("nowhere"))
    policy = AccessPolicy(Tokens(Token(role, role, role) for role in ROLES), DaemonSection())
    return build_app(DaemonClient(display, folder), policy)


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
