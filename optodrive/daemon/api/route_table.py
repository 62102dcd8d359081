"""Routes with the roles that they require: the declaration of a route, and the table of an application's routes.

A route states its role where it is declared, and an application with a route that states none cannot be built.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from re import Pattern
from typing import Any, TypeVar

from fastapi import FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute, APIWebSocketRoute
from starlette.routing import BaseRoute, WebSocketRoute, compile_path
from starlette.routing import Route as HttpRoute

from optodrive.core.errors import suggest_near_name
from optodrive.daemon.api.tokens import Role, is_role_sufficient

STOP = "POST /v1/stop"
ARMING = ("POST /v1/arm", "WEBSOCKET /v1/hold")
"""The routes that arm the board."""
ROLE_ATTRIBUTE = "_min_role"
Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


class RoleRoutes:
    """Declares the routes of an application, each with the lowest role that may call it, None if no token is needed."""

    def __init__(self, app: FastAPI) -> None:
        self._app = app

    def __call__(self, route: str, min_role: Role | None, **options: Any) -> Callable[[Endpoint], Endpoint]:
        """Declare a route, such as "GET /v1/state". options: as of `FastAPI.api_route`."""
        method, path = route.split()
        return self._declare(min_role, self._app.api_route(path, methods=[method], **options))

    def websocket(self, path: str, min_role: Role | None) -> Callable[[Endpoint], Endpoint]:
        """Declare a WebSocket."""
        return self._declare(min_role, self._app.websocket(path))

    def _declare(
        self, min_role: Role | None, register: Callable[[Endpoint], Endpoint]
    ) -> Callable[[Endpoint], Endpoint]:
        def declare(endpoint: Endpoint) -> Endpoint:
            register(endpoint)
            setattr(self._app.routes[-1], ROLE_ATTRIBUTE, min_role)
            return endpoint

        return declare


@dataclass(frozen=True)
class Route:
    """One entry of the table. `key` is its method and path template.

    options: names of the parameters that its query may have; takes_body: whether it reads a body
    """

    key: str
    min_role: Role | None
    method: str
    path: Pattern[str]
    options: tuple[str, ...]
    takes_body: bool

    @property
    def is_audited(self) -> bool:
        """Whether the audit log records the requests: all but reads."""
        return self.method != "GET"


class RouteTable:
    """Matches requests to the routes of an application."""

    def __init__(self, routes: Iterable[BaseRoute]) -> None:
        self._routes = [entry for route in routes for entry in _build_entries(route)]

    @property
    def roles(self) -> dict[str, Role | None]:
        """Method and path template of every route → the lowest role that may call it, None if no token is needed."""
        return {route.key: route.min_role for route in self._routes}

    def list_refused(self, role: Role) -> dict[str, str]:
        """List the routes that a role may not call, with the roles that they require."""
        return {
            key: min_role
            for key, min_role in self.roles.items()
            if min_role is not None and not is_role_sufficient(role, min_role)
        }

    def find(self, method: str, path: str) -> Route | None:
        """Return the route of a request, or None if there is none."""
        return next((route for route in self._routes if route.method == method and route.path.fullmatch(path)), None)

    def find_methods(self, path: str) -> tuple[str, ...]:
        """Return the methods that a path accepts, none for an unknown path."""
        return tuple(route.method for route in self._routes if route.path.fullmatch(path))

    def suggest_path(self, path: str) -> str:
        """Return a phrase with the paths nearest to one that no route has, for a caller who misspelt it."""
        nearest = suggest_near_name(path[:60], sorted({route.key.partition(" ")[2] for route in self._routes}))
        return f"no such route, {nearest or '/openapi.json lists all'}"


def _build_entries(route: BaseRoute) -> Iterator[Route]:
    if isinstance(route, WebSocketRoute):
        methods = {"WEBSOCKET"}
    elif isinstance(route, HttpRoute):
        methods = (route.methods or set()) - {"HEAD"}  # Starlette adds HEAD to every GET
    else:
        raise TypeError(f"a route of a kind that states no role: {route!r}")
    if not hasattr(route, ROLE_ATTRIBUTE):
        raise TypeError(f"the route {route.path} states no role; declare it with RoleRoutes")
    for method in sorted(methods):
        min_role: Role | None = getattr(route, ROLE_ATTRIBUTE)
        options = tuple(_list_options(route.dependant)) if isinstance(route, APIRoute | APIWebSocketRoute) else ()
        takes_body = isinstance(route, APIRoute) and "requestBody" in (route.openapi_extra or {})
        yield Route(f"{method} {route.path}", min_role, method, compile_path(route.path)[0], options, takes_body)


def _list_options(dependant: Dependant) -> Iterator[str]:
    """List the query's parameters of a route and of everything that it depends on."""
    yield from (parameter.alias for parameter in dependant.query_params)
    for each in dependant.dependencies:
        yield from _list_options(each)
