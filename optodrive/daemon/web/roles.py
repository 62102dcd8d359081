"""What each route asks of whoever calls it: the one table. A route that is not in it is not answered."""

from collections.abc import Mapping
from dataclasses import dataclass
from re import Pattern
from typing import Literal, get_args

from starlette.routing import compile_path

from optodrive.daemon.web.static_files import LOGIN_PATHS

Role = Literal["viewer", "operator", "armer"]
"""Each may do what those before it may: look and stop; show; arm."""
ROLES: tuple[Role, ...] = get_args(Role)
STOP = "POST /v1/stop"
ARM = "POST /v1/arm"
ROUTES: Mapping[str, Role | None] = {
    "GET /v1/health": None,
    **{f"GET {path}": None for path in LOGIN_PATHS},
    "GET /": "viewer",
    "GET /page/{name:path}": "viewer",
    "GET /openapi.json": "viewer",
    "GET /v1/telemetry": "viewer",
    "GET /metrics": "viewer",
    "GET /v1/state": "viewer",
    "GET /v1/config": "viewer",
    "GET /v1/patterns": "viewer",
    "GET /v1/plans/{plan_id}": "viewer",
    STOP: "viewer",
    "POST /v1/disarm": "operator",
    "POST /v1/plans": "operator",
    "DELETE /v1/plans/{plan_id}": "operator",
    "POST /v1/patterns/{name}": "operator",
    "WEBSOCKET /v1/stream": "operator",
    ARM: "armer",
}
"""Method and path, as the application has them, → the least role; None: open to all."""


def is_role_sufficient(role: Role, min_role: Role) -> bool:
    """Whether a role may do what asks for at least another."""
    return ROLES.index(role) >= ROLES.index(min_role)


@dataclass(frozen=True)
class Route:
    """A line of the table. key: as it stands there."""

    key: str
    min_role: Role | None
    method: str
    path: Pattern[str]

    @property
    def is_audited(self) -> bool:
        """Whether a call is worth a line in the audit file."""
        return self.method != "GET"


class RouteTable:
    """Finds the line of the table that a request belongs to."""

    def __init__(self, routes: Mapping[str, Role | None]) -> None:
        self._routes = [_build_route(key, min_role) for key, min_role in routes.items()]

    def find(self, method: str, path: str) -> Route | None:
        """The route of a request, None where there is none."""
        return next((route for route in self._routes if route.method == method and route.path.fullmatch(path)), None)

    def find_methods(self, path: str) -> tuple[str, ...]:
        """The methods that a path is answered for; none for a path that is not there."""
        return tuple(route.method for route in self._routes if route.path.fullmatch(path))


def _build_route(key: str, min_role: Role | None) -> Route:
    method, _, path = key.partition(" ")
    return Route(key, min_role, method, compile_path(path)[0])
