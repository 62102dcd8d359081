"""Convert an image for the flash of a Pico: write it as UF2, for the RP2040 with the CRC of its boot loader.

python image.py rp2040|rp2350 board.bin board.uf2: writes board.uf2, and the CRC into board.bin. Format:
github.com/microsoft/uf2.
"""

import struct
import sys
from pathlib import Path

FLASH = 0x1000_0000
BOOT2_BYTES = 256
BLOCK_BYTES = 256
FAMILIES = {"rp2040": 0xE48B_FF56, "rp2350": 0xE48B_FF59}
"""By which a chip's ROM takes a block: the RP2350's is that of secure Arm images."""
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


def build_uf2(image: bytes, family: int) -> bytes:
    """Return UF2 blocks of 512 bytes with 256 bytes of the image each, the last one padded with zeros."""
    pieces = [image[at : at + BLOCK_BYTES].ljust(BLOCK_BYTES, b"\0") for at in range(0, len(image), BLOCK_BYTES)]
    blocks = b""
    for number, piece in enumerate(pieces):
        address = FLASH + number * BLOCK_BYTES
        head = (FIRST, SECOND, HAS_FAMILY, address, BLOCK_BYTES, number, len(pieces), family)
        blocks += struct.pack("<8I", *head) + piece.ljust(476, b"\0") + struct.pack("<I", LAST)
    return blocks


def main() -> int:
    """Write both files; return status 2 for an invalid image."""
    if len(sys.argv) != 4 or sys.argv[1] not in FAMILIES:
        given = " ".join(sys.argv[1:]) or "nothing"
        sys.stderr.write(f"options: got {given}, expected: {'|'.join(FAMILIES)} board.bin board.uf2\n")
        return 2
    chip, binary, target = sys.argv[1], *map(Path, sys.argv[2:])
    try:
        image = binary.read_bytes() if chip == "rp2350" else insert_crc(binary.read_bytes())
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{binary}: {error}\n")
        return 2
    binary.write_bytes(image)
    target.write_bytes(build_uf2(image, FAMILIES[chip]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
