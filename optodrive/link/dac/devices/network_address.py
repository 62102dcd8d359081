"""Addresses of network DACs in the configuration."""

from ipaddress import AddressValueError, IPv6Address

from optodrive.core.errors import InputError


def parse_address(text: str, default_port: int) -> tuple[str, int]:
    """Return host and port of `host`, `host:port`, or an IPv4 address written as IPv6. Raise InputError if it is none.

    These devices speak IPv4 only.
    """
    if text.startswith("["):
        host, _, port = text[1:].partition("]")
        port = port.removeprefix(":")
    elif text.count(":") > 1:
        host, port = text, ""
    else:
        host, _, port = text.partition(":")
    if ":" in host:
        try:
            host = str(IPv6Address(host).ipv4_mapped or "")
        except AddressValueError:
            host = ""
    if not host or (port and not (port.isascii() and port.isdigit() and 0 < int(port) < 65_536)):
        raise InputError("board.port", text, 'the DAC\'s IPv4 address, for example "192.168.1.20"')
    return host, int(port) if port else default_port
