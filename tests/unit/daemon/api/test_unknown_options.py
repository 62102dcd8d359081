"""What a request says and its route does not read is refused by name: keys of query and body, values, repetitions."""

from urllib.parse import urlencode

import pytest
from fastapi import FastAPI

from optodrive.daemon.api.access_middleware import AccessMiddleware
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.route_table import STOP, RoleRoutes, RouteTable
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.device.config_sections import DaemonSection

INVALID = {"name": "\n", "rate_hz": "fast", "dry_run": "maybe", "standing": "maybe"}
"""Values that a parameter may not have; text alone is invalid for the others."""


@pytest.fixture(scope="module")
def routes(app):
    """Every route of the application, from its own table."""
    routes = RouteTable(app.routes)._routes
    assert len(routes) > 25
    assert {option for route in routes for option in route.options} >= {"dry_run", "policy", "fit", "newest", "rate_hz"}
    return [route for route in routes if route.key != STOP]


def test_an_unknown_key_of_a_query_is_refused_on_every_route(ask, routes):
    for route in routes:
        status, problem = ask(route.key, "surely_unknown=1")
        assert (status, problem["code"]) == (422, "unknown_key"), route.key
        assert problem["detail"].startswith("query: got 'surely_unknown', expected "), route.key


def test_a_misspelt_key_is_refused_with_the_nearest_on_every_route(ask, routes):
    for route in routes:
        for option in route.options:
            for wrong in {option[:-1], f"{option}s", option.upper(), option.replace("_", "-"), f" {option}"} - {option}:
                status, problem = ask(route.key, urlencode({wrong: "true"}))
                assert (status, problem["code"]) == (422, "unknown_key"), (route.key, wrong)
                assert problem["value"] == repr(wrong)
                assert problem["expected"] == f"a known key, nearest is '{option}'", (route.key, wrong)


def test_a_repeated_key_and_an_invalid_value_are_refused_on_every_route(ask, routes):
    for route in routes:
        for option in route.options:
            status, problem = ask(route.key, f"{option}=1&{option}=2")
            assert (status, problem["code"]) == (422, "repeated_key"), (route.key, option)
            for value in (INVALID.get(option, "surely-unknown"), ""):
                status, problem = ask(route.key, urlencode({option: value}))
                assert (status, problem["where"]) == (422, f"query.{option}"), (route.key, option, value)
                assert problem["detail"].startswith(f"query.{option}: got {value!r}, expected "), problem


def test_a_body_is_refused_on_every_route_that_reads_none(ask, routes):
    reading = {route.key for route in routes if route.takes_body}
    assert reading == {"PUT /v1/dim", "POST /v1/plans", "POST /v1/patterns/{name}"}
    for route in routes:
        if not route.takes_body and not route.key.startswith("WEBSOCKET"):
            status, problem = ask(route.key, body=b'{"hold": true}')
            assert (status, problem["where"]) == (422, "body"), route.key
            assert problem["detail"].endswith(f"expected none: {route.key} takes no body")


def test_stop_is_never_refused_for_what_it_does_not_read(ask):
    """Another application, whose STOP only counts."""
    stops = []
    app = FastAPI()

    @RoleRoutes(app)(STOP, "viewer")
    async def stop() -> None:
        stops.append(1)

    policy = AccessPolicy(Tokens([Token("viewer", "viewer", "viewer")]), DaemonSection())
    app.add_middleware(AccessMiddleware, policy=policy, table=RouteTable(app.routes[-1:]))
    for query, body in (("dry_run=true", b""), ("now&now", b""), ("", b'{"dry_run": true}')):
        assert ask(STOP, query, body, "viewer", to=app) == (200, None)
    assert len(stops) == 3


@pytest.mark.parametrize(
    ("body", "detail"),
    [
        ('{"shar": 0.4}', "body: shar: got 'shar', expected a known key, nearest is 'share'"),
        ('{"share": 0.4, "hold": true}', "body: hold: got 'hold', expected a known key, one of share"),
        ('{"share": 0.4, "share": 1}', "body: got 'share', expected each key of an object once"),
        ("", "body: share: missing, expected this key"),
    ],
)
def test_the_body_of_a_dimming_is_refused_by_name(ask, body, detail):
    status, problem = ask("PUT /v1/dim", body=body.encode())
    assert (status, problem["detail"]) == (422, detail)
