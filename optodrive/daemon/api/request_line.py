"""Path and headers of a request as every check reads them, in whichever form the client wrote them."""

import re
from collections.abc import Iterable

STOP_PATH = "/v1/stop"
AUTHORITY = re.compile(r"https?://[^/]*", re.IGNORECASE)


def normalise_path(path: str) -> str:
    """Return the path of a decoded request target: without scheme and host, and STOP's without a slash at its end."""
    authority = AUTHORITY.match(path)
    if authority is not None:
        path = path[authority.end() :] or "/"
    return STOP_PATH if path == STOP_PATH + "/" else path


def join_headers(lines: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the headers by lower-case name, the values of a repeated one as a list, which no Host or Origin is."""
    headers: dict[str, str] = {}
    for name, value in lines:
        key = name.lower()
        headers[key] = f"{headers[key]}, {value}" if key in headers else value
    return headers
