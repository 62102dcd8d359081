"""Drawings from ILDA files (.ild), which laser shows and lasers' editors write.

After the ILDA Image Data Transfer Format, revision 11: sections of format 0, 1, 4 and 5 are pictures of points, with
and without a third coordinate, by a colour's index or by red, green and blue; format 2 is a palette for the indices of
later sections. A section without records ends the file. The light draws from each point to the next one unless that is
blanked or black. The third coordinate is left out, as seen from the front.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.types.arrays import BoolArray, IntArray

MARK = b"ILDA"
HEADER = struct.Struct(">4s3xB8s8sHHHBx")
PALETTE = 2
RECORDS = {
    0: np.dtype([("x", ">i2"), ("y", ">i2"), ("z", ">i2"), ("status", "u1"), ("index", "u1")]),
    1: np.dtype([("x", ">i2"), ("y", ">i2"), ("status", "u1"), ("index", "u1")]),
    PALETTE: np.dtype([("red", "u1"), ("green", "u1"), ("blue", "u1")]),
    4: np.dtype([("x", ">i2"), ("y", ">i2"), ("z", ">i2"), ("status", "u1"), ("bgr", "u1", 3)]),
    5: np.dtype([("x", ">i2"), ("y", ">i2"), ("status", "u1"), ("bgr", "u1", 3)]),
}
"""Records by a section's format."""
BLANKED = 0x40
"""Bit of a point's status."""
OWN_PALETTE = 64
"""Colours of the standard's palette, none of which is black."""
PICTURES_MAX = 100
"""Pictures of a file: a second or two of rendering."""
FULL, LINE = 65_536, 100
"""Width of the plane and of a line in the file's units."""


class _Section(NamedTuple):
    """One section: its number in the file, format and projector, and its records."""

    number: int
    kind: int
    projector: int
    records: np.ndarray


def is_ilda(file: bytes) -> bool:
    """Return whether a file is one of ILDA."""
    return file.startswith(MARK)


def convert_ilda(file: bytes, where: str) -> list[bytes | None]:
    """Return each picture of a file as an SVG drawing, None for a dark one.

    Raises InputError (bad_picture, too_many).
    """
    visible = np.ones(OWN_PALETTE, dtype=bool)
    projectors: set[int] = set()
    pictures: list[bytes | None] = []
    for section in _list_sections(file, where):
        records = section.records
        if section.kind == PALETTE:
            visible = (records["red"] | records["green"] | records["blue"]) > 0
            continue
        projectors.add(section.projector)
        if len(projectors) > 1:
            raise _wrong(
                where, section.number, f"projector {section.projector}", f"projector {min(projectors)} as above"
            )
        is_bright = (records["status"] & BLANKED) == 0
        if "index" in (records.dtype.names or ()):
            beyond = records["index"][is_bright & (records["index"] >= len(visible))]
            if len(beyond):
                raise _wrong(
                    where, section.number, f"colour {beyond[0]}", f"a colour of the palette, 0 to {len(visible) - 1}"
                )
            is_bright[is_bright] = visible[records["index"][is_bright]]
        else:
            is_bright &= records["bgr"].any(axis=1)
        if len(pictures) == PICTURES_MAX:
            raise InputError(where, Unquoted(f"more than {PICTURES_MAX} pictures"), "fewer", code="too_many")
        pictures.append(_draw(records["x"].astype(np.int64), records["y"].astype(np.int64), is_bright))
    if not pictures:
        raise InputError(where, Unquoted("an ILDA file without a picture"), "one with points", code="bad_picture")
    return pictures


def _list_sections(file: bytes, where: str) -> Iterator[_Section]:
    position, number = 0, 1
    while position < len(file):
        if len(file) - position < HEADER.size:
            found = f"{len(file) - position} bytes at its end"
            raise _wrong(where, number, found, f"a header of {HEADER.size}")
        mark, kind, _, _, count, _, _, projector = HEADER.unpack_from(file, position)
        if mark != MARK:
            raise _wrong(where, number, f"{mark!r} at byte {position}", MARK.decode())
        if count == 0:
            return
        if kind not in RECORDS:
            raise _wrong(where, number, f"format {kind}", f"one of {', '.join(map(str, RECORDS))}")
        position += HEADER.size
        size = count * RECORDS[kind].itemsize
        if len(file) - position < size:
            raise _wrong(where, number, f"{len(file) - position} bytes for {count} records", str(size))
        yield _Section(number, kind, projector, np.frombuffer(file, RECORDS[kind], count, position))
        position, number = position + size, number + 1


def _wrong(where: str, section: int, found: str, expected: str) -> InputError:
    return InputError(f"{where}: section {section}", Unquoted(found), expected, code="bad_picture")


def _draw(x: IntArray, y: IntArray, is_bright: BoolArray) -> bytes | None:
    """Return a picture as SVG, None if it is dark. The light reaches a bright point from the one before it."""
    parts: list[str] = []
    for k in range(1, len(x)):
        if is_bright[k]:
            start = "" if is_bright[k - 1] and parts else f"M{x[k - 1]} {-y[k - 1]}"
            parts.append(f"{start}L{x[k]} {-y[k]}")
    if len(x) == 1 and is_bright[0]:
        parts.append(f"M{x[0]} {-y[0]}L{x[0]} {-y[0]}")
    if not parts:
        return None
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{-FULL // 2} {-FULL // 2} {FULL} {FULL}">'
    # Round ends: a beam that rests is a dot.
    style = f'fill="none" stroke="#000" stroke-width="{LINE}" stroke-linecap="round" stroke-linejoin="round"'
    return f'{head}<path {style} d="{"".join(parts)}"/></svg>'.encode()
