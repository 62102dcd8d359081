"""Addresses of network DACs in the configuration."""

from optodrive.core.errors import InputError


def parse_address(text: str, default_port: int) -> tuple[str, int]:
    """Return host and port of `host` or `host:port`. Raise InputError if it is neither."""
    host, _, port = text.partition(":")
    if not host or (port and not (port.isascii() and port.isdigit() and 0 < int(port) < 65_536)):
        raise InputError("board.port", text, 'the DAC\'s address, for example "192.168.1.20"')
    return host, int(port) if port else default_port
