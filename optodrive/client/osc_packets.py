"""Packets of Open Sound Control 1.0: messages and bundles of them, as a source sends them by UDP.

A packet is a message (address, type tags, arguments) or a bundle (#bundle, a time, sizes and packets). Everything is
big-endian and padded to four bytes. The time of a bundle is not used: what it holds counts at once, and together.
"""

import struct
from typing import NamedTuple

from optodrive.core.errors import InputError, Unquoted

CODE = "bad_osc"
DEPTH_MAX = 8
"""Bundles within bundles."""
BUNDLE = b"#bundle\0"
NUMBERS = {"i": ">i", "f": ">f", "h": ">q", "d": ">d"}
CONSTANTS = {"T": 1.0, "F": 0.0}
Argument = float | int | str | bytes | None


class OscMessage(NamedTuple):
    """A message: its address, such as /pixel/17, and its arguments."""

    address: str
    arguments: tuple[Argument, ...]


def parse_packet(data: bytes, where: str = "OSC packet", depth: int = 0) -> list[OscMessage]:
    """Return the messages of a packet in order. Raise InputError (bad_osc)."""
    if not data.startswith(BUNDLE):
        return [_parse_message(data, where)]
    if depth == DEPTH_MAX:
        raise InputError(where, Unquoted("more"), f"at most {DEPTH_MAX} bundles within each other", code=CODE)
    messages, at = list[OscMessage](), len(BUNDLE) + 8
    while at < len(data):
        size = int(_unpack(">i", data, at, where))
        at += 4
        if not 0 < size <= len(data) - at:
            raise InputError(where, Unquoted(f"an element of {size} bytes"), "one within the bundle", code=CODE)
        messages += parse_packet(data[at : at + size], where, depth + 1)
        at += size
    return messages


def build_message(address: str, *arguments: float | int) -> bytes:
    """Build a message with integers and floats."""
    tags = "," + "".join("i" if isinstance(each, int) else "f" for each in arguments)
    values = b"".join(
        struct.pack(">i" if tag == "i" else ">f", each) for tag, each in zip(tags[1:], arguments, strict=True)
    )
    return _pad(address) + _pad(tags) + values


def _pad(text: str) -> bytes:
    data = text.encode()
    return data + bytes(4 - len(data) % 4)


def _parse_message(data: bytes, where: str) -> OscMessage:
    address, at = _read_text(data, 0, where)
    if not address.startswith("/"):
        raise InputError(where, address[:40], "an address that begins with /", code=CODE)
    if at >= len(data):
        return OscMessage(address, ())
    tags, at = _read_text(data, at, where)
    if not tags.startswith(","):
        raise InputError(f"{where} {address[:40]}", tags[:40], "type tags that begin with a comma", code=CODE)
    arguments = list[Argument]()
    for tag in tags[1:]:
        if tag in NUMBERS:
            arguments.append(_unpack(NUMBERS[tag], data, at, where))
            at += struct.calcsize(NUMBERS[tag])
        elif tag in CONSTANTS:
            arguments.append(CONSTANTS[tag])
        elif tag == "s":
            text, at = _read_text(data, at, where)
            arguments.append(text)
        elif tag == "b":
            size = int(_unpack(">i", data, at, where))
            if not 0 <= size <= len(data) - at - 4:
                raise InputError(where, Unquoted(f"a blob of {size} bytes"), "one within the packet", code=CODE)
            arguments.append(data[at + 4 : at + 4 + size])
            at += 4 + size + -size % 4
        elif tag == "N":
            arguments.append(None)
        else:
            expected = "type tags i, f, h, d, s, b, T, F or N"
            raise InputError(f"{where} {address[:40]}", tag, expected, code=CODE)
    return OscMessage(address, tuple(arguments))


def _read_text(data: bytes, at: int, where: str) -> tuple[str, int]:
    """Return a text of ASCII that ends with a zero, and the place behind it."""
    end = data.find(b"\0", at)
    if end < 0 or not data[at:end].isascii():
        raise InputError(where, data[at : at + 20], "text in ASCII that ends with a zero", code=CODE)
    return data[at:end].decode("ascii"), end + 4 - end % 4


def _unpack(form: str, data: bytes, at: int, where: str) -> float | int:
    try:
        value: float | int = struct.unpack_from(form, data, at)[0]
    except struct.error:
        raise InputError(where, Unquoted(f"{len(data)} bytes"), "a packet with all its arguments", code=CODE) from None
    return value
