"""The page's files, the cookie that gives access to them, and the security headers that they are sent with.

A browser cannot send a bearer header for a page, so GET requests for `/` and `/page/*` accept the token from a cookie,
too; the page's requests to the API carry the header. A cookie is not bound to a port, so its name contains the port.
"""

from importlib.resources import files
from importlib.resources.abc import Traversable
from mimetypes import guess_type

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from optodrive.daemon.api.route_table import RoleRoutes

LOGIN_PATHS = ("/page/login.js", "/page/login.css", "/page/colours.css")
"""The files of the login page; they contain no secret."""
SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Cache-Control": "no-store",
}
MEDIA_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}


def is_page_request(method: str, path: str) -> bool:
    """Return whether a request is for a file of the page."""
    return method == "GET" and (path == "/" or path.startswith("/page/"))


def read_cookie_token(headers: dict[str, str]) -> str:
    """Return the token in a browser's cookie, '' if there is none.

    Of several with one name, the first is that of the longest path (RFC 6265, 5.4): of the display's own page at an
    address where a proxy shows several.
    """
    cookie = f"optodrive-{_parse_port(headers.get('host', ''))}"
    pairs = (part.strip().partition("=") for part in headers.get("cookie", "").split(";"))
    return next((value for name, _, value in pairs if name == cookie), "")


def _parse_port(host: str) -> str:
    port = host.rpartition(":")[2]
    return port if port.isdigit() else "80"


def load_login_page() -> bytes:
    """Return the HTML of the login page."""
    return _get_page_folder().joinpath("login.html").read_bytes()


def _get_page_folder() -> Traversable:
    return files("optodrive.daemon").joinpath("page")


def add_page_routes(routes: RoleRoutes) -> None:
    """Serve the page at `/` and its files below `/page/`. All are read beforehand, so that no path leads elsewhere."""
    contents = dict(_read_files(_get_page_folder(), ""))

    @routes("GET /", "viewer", include_in_schema=False)
    async def get_index() -> Response:
        return _build_response("index.html", contents["index.html"])

    async def get_login_file(request: Request) -> Response:
        name = request.url.path.removeprefix("/page/")
        return _build_response(name, contents[name])

    for path in LOGIN_PATHS:
        routes(f"GET {path}", None, include_in_schema=False)(get_login_file)

    @routes("GET /page/{name:path}", "viewer", include_in_schema=False)
    async def get_file(name: str) -> Response:
        if name not in contents:
            raise HTTPException(404)
        return _build_response(name, contents[name])


def _read_files(folder: Traversable, prefix: str) -> list[tuple[str, bytes]]:
    contents: list[tuple[str, bytes]] = []
    for item in folder.iterdir():
        if item.is_dir():
            contents += _read_files(item, f"{prefix}{item.name}/")
        else:
            contents.append((prefix + item.name, item.read_bytes()))
    return contents


def _build_response(name: str, content: bytes) -> Response:
    suffix = "." + name.rpartition(".")[2]
    return Response(
        content, media_type=MEDIA_TYPES.get(suffix) or guess_type(name)[0] or "text/plain", headers=SECURITY_HEADERS
    )
