"""Form of a binary frame of a stream: a header, then two bytes per pixel, little-endian."""

import struct

MAGIC = b"ODF1"
HEADER = struct.Struct("<4sI")
HEIGHT_UNIT_M = 1e-7
"""Unit of binary heights, m."""
FRAME_NUMBER_MAX = 0xFFFF_FFFF
