import pytest
from fastapi import FastAPI
from starlette.routing import Mount

from optodrive.daemon.api.route_table import ARMING, STOP, RoleRoutes, RouteTable
from optodrive.daemon.api.static_files import LOGIN_PATHS
from optodrive.daemon.api.tokens import ROLES, is_role_sufficient


@pytest.fixture
def table(app):
    return RouteTable(app.routes)


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
