"""Convert an image for the RP2040's flash: insert the CRC of the boot loader, and write it as UF2.

python image.py board.bin board.uf2: changes board.bin, writes board.uf2. Format: github.com/microsoft/uf2.
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


def compute_crc(data: bytes) -> int:
    """Compute the CRC that the chip's ROM checks: CRC-32, 0x04C11DB7, MSB first, initial value ones, not inverted."""
    value = 0xFFFF_FFFF
    for byte in data:
        value ^= byte << 24
        for _ in range(8):
            value = (value << 1 ^ (0x04C1_1DB7 if value >> 31 else 0)) & 0xFFFF_FFFF
    return value


def insert_crc(image: bytes) -> bytes:
    """Insert the CRC of the first 252 bytes behind them; raise ValueError if these four bytes are in use."""
    content, end = image[: BOOT2_BYTES - 4], image[BOOT2_BYTES - 4 : BOOT2_BYTES]
    if end not in (bytes(4), struct.pack("<I", compute_crc(content))):
        raise ValueError(f"boot loader: got {end.hex()} in its last four bytes, expected zeros")
    return content + struct.pack("<I", compute_crc(content)) + image[BOOT2_BYTES:]


def build_uf2(image: bytes) -> bytes:
    """Return UF2 blocks of 512 bytes with 256 bytes of the image each, the last one padded with zeros."""
    pieces = [image[at : at + BLOCK_BYTES].ljust(BLOCK_BYTES, b"\0") for at in range(0, len(image), BLOCK_BYTES)]
    blocks = b""
    for number, piece in enumerate(pieces):
        address = FLASH + number * BLOCK_BYTES
        head = (FIRST, SECOND, HAS_FAMILY, address, BLOCK_BYTES, number, len(pieces), RP2040_FAMILY)
        blocks += struct.pack("<8I", *head) + piece.ljust(476, b"\0") + struct.pack("<I", LAST)
    return blocks


def main() -> int:
    """Write both files; return status 2 for an invalid image."""
    if len(sys.argv) != 3:
        sys.stderr.write(f"options: got {' '.join(sys.argv[1:]) or 'nothing'}, expected: board.bin board.uf2\n")
        return 2
    binary, target = map(Path, sys.argv[1:])
    try:
        image = insert_crc(binary.read_bytes())
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{binary}: {error}\n")
        return 2
    binary.write_bytes(image)
    target.write_bytes(build_uf2(image))
    return 0


if __name__ == "__main__":
    sys.exit(main())
