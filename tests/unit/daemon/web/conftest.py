"""Application on an engine that is not started, for tests of routes."""

import asyncio

import httpx
import pytest

from optodrive.core.clock import MonotonicClock
from optodrive.daemon.one_process.engine import Engine
from optodrive.daemon.web.access_policy import AccessPolicy
from optodrive.daemon.web.api import build_app
from optodrive.daemon.web.roles import ROLES
from optodrive.daemon.web.tokens import Token, Tokens
from optodrive.device.config import DaemonSection
from optodrive.device.config_file import load_config
from optodrive.link.transport.simulated import SimulatedBoard
from optodrive.planning.display_model import DisplayModel


@pytest.fixture(scope="session")
def app():
    """Application of the smallest display, with one token per role, whose secret is the role's name."""
    display = DisplayModel.from_config(load_config("display-16"))
    engine = Engine(display, SimulatedBoard("", 1_000_000), MonotonicClock())
    policy = AccessPolicy(Tokens(Token(role, role, role) for role in ROLES), DaemonSection())
    yield build_app(engine, policy)
    engine.close()


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
