"""HTTP of a study's pages: their address and files, and the check of Host and Origin before every request."""

from collections.abc import Mapping
from contextlib import suppress
from importlib.resources import files
from ipaddress import ip_address
from typing import NamedTuple

from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect

from optodrive.core.errors import InputError
from optodrive.daemon.api.error_handlers import send_problem
from optodrive.daemon.api.host_check import LOOPBACK_NAMES, check_host_and_origin
from optodrive.daemon.api.request_limits import App, Receive, Scope, Send, join_headers
from optodrive.daemon.api.static_files import MEDIA_TYPES, SECURITY_HEADERS

LOOPBACK = "127.0.0.1"


class PageAddress(NamedTuple):
    """Where the pages are served. port: 0 for any free one."""

    host: str
    port: int

    @property
    def is_local(self) -> bool:
        """Whether only programs of this computer reach it, which may also call it by another name."""
        return self.host in LOOPBACK_NAMES


def parse_page_address(option: str, text: str) -> PageAddress:
    """Parse `PORT`, on loopback, or `HOST:PORT`. Raise InputError."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) <= 65535) or ":" in host:
        raise InputError(option, text, "PORT or HOST:PORT, a port from 0 to 65535")
    with suppress(ValueError):
        if ip_address(host).is_unspecified:
            raise InputError(option, text, "the address by which the participant's device reaches this computer")
    return PageAddress(host or LOOPBACK, int(port))


SHARED_FILES = ("colours.css", "announcer.js")
"""Files of the daemon's page."""


class HostCheck:
    """Refuses requests by Host and Origin, in front of the application."""

    def __init__(self, app: App, hosts: set[str]) -> None:
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        headers = join_headers((name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"])
        problem = check_host_and_origin(headers, self._hosts)
        if problem is None:
            with suppress(WebSocketDisconnect):  # a page that left while something was sent to it
                await self._app(scope, receive, send)
        else:
            await send_problem(send, problem, "websocket.http" if scope["type"] == "websocket" else "http")


def read_files() -> dict[str, bytes]:
    """Return the content of every file of the pages by its name."""
    contents = {item.name: item.read_bytes() for item in files("optodrive.study").joinpath("page").iterdir()}
    shared = files("optodrive.daemon").joinpath("page")
    return contents | {name: shared.joinpath(name).read_bytes() for name in SHARED_FILES}


def build_response(name: str, contents: Mapping[str, bytes]) -> Response:
    """Return a file of the pages. Raise HTTPException (404) for another name."""
    if name not in contents:
        raise HTTPException(404)
    return Response(contents[name], media_type=MEDIA_TYPES["." + name.rpartition(".")[2]], headers=SECURITY_HEADERS)
