import pytest
from fastapi import FastAPI
from starlette.routing import Mount

from optodrive.daemon.api.access_middleware import AccessMiddleware
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.route_table import ARMING, STOP, RoleRoutes, RouteTable
from optodrive.daemon.api.static_files import LOGIN_PATHS, is_page_request
from optodrive.daemon.api.tokens import ROLES, Token, Tokens, is_role_sufficient
from optodrive.device.config_sections import DaemonSection


@pytest.fixture
def table(app):
    return RouteTable(app.routes)


REFUSALS = {
    "no token": ({"authorization": None}, 401, "bad_token"),
    "an empty token": ({"authorization": "Bearer"}, 401, "bad_token"),
    "a wrong token": ({"authorization": "Bearer wrong"}, 401, "bad_token"),
    "another scheme": ({"authorization": "Basic armer"}, 401, "bad_token"),
    "a foreign Host": ({"host": "evil.example"}, 421, "host_not_allowed"),
    "a Host like ours": ({"host": "localhost.evil.example"}, 421, "host_not_allowed"),
    "another port's Origin": ({"origin": "http://localhost:1"}, 403, "origin_not_allowed"),
    "a foreign Origin": ({"origin": "https://evil.example"}, 403, "origin_not_allowed"),
    "no page's Origin": ({"origin": "null"}, 403, "origin_not_allowed"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_every_route_refuses(ask, table, case):
    headers, status, code = REFUSALS[case]
    for key, min_role in table.roles.items():
        found, problem = ask(key, **headers)
        if status == 401 and min_role is None:
            assert found == 200, key
        else:
            assert found == status, key
            is_page = status == 401 and is_page_request(*key.split(" "))  # the page that requests the token
            assert (problem and problem["code"]) == (None if is_page else code), key


def test_every_route_refuses_each_insufficient_role_and_admits_the_others(ask, app, table):
    """Behind the policy is another application, which only counts."""
    admitted = []

    async def count(scope, receive, send):
        admitted.append(scope["path"])

    policy = AccessPolicy(Tokens(Token(role, role, role) for role in ROLES), DaemonSection(requests_burst=1000))
    guarded = AccessMiddleware(count, policy, table)
    for key, min_role in table.roles.items():
        first = 0 if min_role is None else ROLES.index(min_role)
        for number, role in enumerate(ROLES):
            admitted.clear()
            status, problem = ask(key, role=role, to=guarded)
            assert len(admitted) == (number >= first), (key, role)
            if number < first:
                assert (status, problem["code"]) == (403, "insufficient_role"), (key, role)
                assert ask(key, role=role)[0] == 403, (key, role)


@pytest.mark.parametrize(
    ("key", "status"), [("GET /v1/nothing", 404), ("PUT /v1/arm", 405), ("OPTIONS /v1/state", 405)]
)
def test_an_unknown_route_requires_a_token_first(send, key, status):
    assert send(*key.split(" "), role=None).status_code == 401
    response = send(*key.split(" "))
    assert response.status_code == status
    assert (status == 405) == ("allow" in response.headers)
    assert "access-control-allow-origin" not in response.headers


def test_a_route_that_is_added_later_is_not_answered(ask, own_app):
    """Mutant."""

    @own_app.post("/v1/laser")
    async def laser():
        return {"on": True}

    status, problem = ask("POST /v1/laser", to=own_app)
    assert (status, problem["code"]) == (404, "route_not_found")


def test_each_role_may_do_what_the_lesser_ones_may():
    for index, role in enumerate(ROLES):
        assert [is_role_sufficient(role, minimum) for minimum in ROLES] == [
            place <= index for place in range(len(ROLES))
        ]


@pytest.mark.parametrize(
    ("method", "path", "key"),
    [
        ("GET", "/v1/plans/p1", "GET /v1/plans/{plan_id}"),
        ("DELETE", "/v1/plans/p1", "DELETE /v1/plans/{plan_id}"),
        ("POST", "/v1/patterns/text", "POST /v1/patterns/{name}"),
        ("WEBSOCKET", "/v1/stream", "WEBSOCKET /v1/stream"),
    ],
)
def test_a_request_is_found_by_its_template(table, method, path, key):
    assert table.find(method, path).key == key


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("HEAD", "/v1/state"),
        ("GET", "/v1/state/"),
        ("GET", "/v1/plans/"),
        ("GET", "/v1/plans/p1/pulses"),
        ("GET", "/v1/stream"),
        ("GET", "/V1/STATE"),
        ("GET", "//v1/health"),
        ("GET", "/v1/health\n"),
    ],
)
def test_what_is_not_in_the_table_is_not_found(table, method, path):
    assert table.find(method, path) is None


def test_stop_asks_for_the_least_role_and_arm_for_the_highest(table):
    assert table.roles["POST /v1/stop"] == ROLES[0]
    assert table.roles["POST /v1/arm"] == ROLES[-1]
    assert {key for key, minimum in table.roles.items() if minimum is None} == {
        "GET /v1/health",
        *(f"GET {path}" for path in LOGIN_PATHS),
    }


def test_routes_of_one_handler_keep_their_own_roles():
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    routes = RoleRoutes(app)

    async def handler():
        return None

    routes("GET /a", None)(handler)
    routes("POST /a", "armer")(handler)
    assert RouteTable(app.routes).roles == {"GET /a": None, "POST /a": "armer"}


def test_an_application_with_a_route_without_a_role_is_refused():
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    assert RouteTable(app.routes).roles == {}

    @app.post("/v1/laser")
    async def laser():
        return {"on": True}

    with pytest.raises(TypeError, match="/v1/laser states no role"):
        RouteTable(app.routes)
    with pytest.raises(TypeError, match="states no role"):
        RouteTable([Mount("/files", FastAPI())])


def test_what_a_role_may_not_call_is_listed_with_the_role_that_may(table):
    refused = {role: table.list_refused(role) for role in ROLES}
    assert refused["operator"] == dict.fromkeys((*ARMING, "POST /v1/reload"), "armer")
    assert refused["armer"] == {}
    assert refused["viewer"].items() > refused["operator"].items()
    assert STOP not in refused["viewer"]
