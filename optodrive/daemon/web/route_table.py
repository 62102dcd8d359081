"""The table of all routes with the role that each requires."""

from collections.abc import Mapping
from dataclasses import dataclass
from re import Pattern

from starlette.routing import compile_path

from optodrive.daemon.web.roles import Role
from optodrive.daemon.web.static_files import LOGIN_PATHS

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
"""Method and path template, as the application declares them, → the lowest role that may call it; None: no token."""


@dataclass(frozen=True)
class Route:
    """One entry of the table; `key` is its method and path template."""

    key: str
    min_role: Role | None
    method: str
    path: Pattern[str]

    @property
    def is_audited(self) -> bool:
        """Whether the audit log records the requests: all but reads."""
        return self.method != "GET"


class RouteTable:
    """Matches requests to entries of the table."""

    def __init__(self, routes: Mapping[str, Role | None]) -> None:
        self._routes = [_build_route(key, min_role) for key, min_role in routes.items()]

    def find(self, method: str, path: str) -> Route | None:
        """Return the route of a request; None if there is none."""
        return next((route for route in self._routes if route.method == method and route.path.fullmatch(path)), None)

    def find_methods(self, path: str) -> tuple[str, ...]:
        """Return the methods that a path accepts; none for an unknown path."""
        return tuple(route.method for route in self._routes if route.path.fullmatch(path))


def _build_route(key: str, min_role: Role | None) -> Route:
    method, _, path = key.partition(" ")
    return Route(key, min_role, method, compile_path(path)[0])
