"""The flash's content as the RP2040 wants it: the second stage's CRC put in, and the whole as UF2.

python image.py board.bin board.uf2: changes board.bin, writes board.uf2. UF2's format: github.com/microsoft/uf2.
"""

import struct
import sys
from pathlib import Path

FLASH = 0x1000_0000
BOOT2_BYTES = 256
BLOCK_BYTES = 256
RP2040_FAMILY = 0xE48B_FF56
HAS_FAMILY = 0x2000
FIRST, SECOND, LAST = 0x0A32_4655, 0x9E5D_5157, 0x0AB1_6F30


def crc(data: bytes) -> int:
    """What the chip's ROM compares: CRC-32, 0x04C11DB7, most significant bit first, begun with ones, not inverted."""
    value = 0xFFFF_FFFF
    for byte in data:
        value ^= byte << 24
        for _ in range(8):
            value = (value << 1 ^ (0x04C1_1DB7 if value >> 31 else 0)) & 0xFFFF_FFFF
    return value


def with_crc(image: bytes) -> bytes:
    """The image with the CRC of its first 252 bytes behind them; ValueError where these four are not free."""
    content, end = image[: BOOT2_BYTES - 4], image[BOOT2_BYTES - 4 : BOOT2_BYTES]
    if end not in (bytes(4), struct.pack("<I", crc(content))):
        raise ValueError(f"second stage: got {end.hex()} in its last four bytes, expected zeros")
    return content + struct.pack("<I", crc(content)) + image[BOOT2_BYTES:]


def uf2(image: bytes) -> bytes:
    """Blocks of 512 bytes, 256 of the image in each, the last one filled up with zeros."""
    pieces = [image[at : at + BLOCK_BYTES].ljust(BLOCK_BYTES, b"\0") for at in range(0, len(image), BLOCK_BYTES)]
    blocks = b""
    for number, piece in enumerate(pieces):
        address = FLASH + number * BLOCK_BYTES
        head = (FIRST, SECOND, HAS_FAMILY, address, BLOCK_BYTES, number, len(pieces), RP2040_FAMILY)
        blocks += struct.pack("<8I", *head) + piece.ljust(476, b"\0") + struct.pack("<I", LAST)
    return blocks


def main() -> int:
    """Both files; status 2 for what is no image."""
    if len(sys.argv) != 3:
        sys.stderr.write(f"options: got {' '.join(sys.argv[1:]) or 'nothing'}, expected: board.bin board.uf2\n")
        return 2
    binary, target = map(Path, sys.argv[1:])
    try:
        image = with_crc(binary.read_bytes())
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{binary}: {error}\n")
        return 2
    binary.write_bytes(image)
    target.write_bytes(uf2(image))
    return 0


if __name__ == "__main__":
    sys.exit(main())
