"""Where the pages of a study are served."""

from contextlib import suppress
from ipaddress import ip_address
from typing import NamedTuple

from optodrive.core.errors import InputError
from optodrive.daemon.api.host_check import LOOPBACK_NAMES

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
