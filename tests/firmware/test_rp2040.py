"""The port to the Raspberry Pi Pico without hardware: it builds, and the ROM accepts the image.

The same for the Pico 2, whose chip no emulator has: that it builds says nothing about whether it runs.
"""

import re
import struct
import subprocess
import sys
import zlib
from collections import namedtuple
from pathlib import Path

import pytest

from firmware_ports import require

PORT = Path(__file__).parents[2] / "firmware_protocol" / "ports" / "rp2040"
FLASH, RAM, RAM_END = 0x1000_0000, 0x2000_0000, 0x2004_2000
IMAGE_MAX = 32 * 1024
STACK_MIN = 8 * 1024
CRC_AT = 252
FORBIDDEN = re.compile(r"_*(([mc]|re)alloc|free|sbrk|v?[sf]?n?i?printf|puts|exit|abort)(_r)?")
Block = namedtuple("Block", "first second flags address size number count family data last")


def run(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def make(folder, *targets):
    """Build the port in a folder, without a warning."""
    require("arm-none-eabi-gcc", "make")
    built = subprocess.run(["make", "-s", "-C", PORT, f"BUILD={folder}", *targets], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    assert not built.stderr, "warnings"
    return folder


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    return make(tmp_path_factory.mktemp("rp2040"))


@pytest.fixture(scope="module")
def build_2350(tmp_path_factory):
    return make(tmp_path_factory.mktemp("rp2350"), "pico2") / "pico2"


@pytest.fixture(scope="module")
def image(build):
    return (build / "board.bin").read_bytes()


def read_symbols(elf):
    """Return the addresses of all symbols by name."""
    listed = [line.split() for line in run("arm-none-eabi-nm", elf).splitlines()]
    return {name: int(address, 16) for address, _, name in listed}


@pytest.fixture(scope="module")
def symbols(build):
    return read_symbols(build / "board.elf")


def rom_crc(data):
    """Compute CRC-32 MSB first with zlib's LSB-first function."""
    turned = bytes(int(f"{byte:08b}"[::-1], 2) for byte in data)
    return int(f"{~zlib.crc32(turned) & 0xFFFFFFFF:032b}"[::-1], 2)


def test_rom_takes_the_second_stage(image):
    assert struct.unpack_from("<I", image, CRC_AT)[0] == rom_crc(image[:CRC_AT])
    assert any(image[:CRC_AT])


def test_second_stage_may_stand_anywhere(build):
    """The ROM runs a copy of the boot loader, which must not refer to other flash contents than the vectors."""
    listed = run("arm-none-eabi-objdump", "-d", "-j", ".boot2", build / "board.elf")
    code = listed[listed.index("<boot2>:") :]
    assert "\tbl\t" not in code
    words = [int(line.split(".word\t0x")[1], 16) for line in code.splitlines() if ".word\t0x" in line]
    assert {word for word in words if FLASH <= word < FLASH + IMAGE_MAX} == {FLASH + 256, FLASH + 260}
    assert not [word for word in words if RAM <= word < RAM_END]


def test_vectors(image, symbols):
    stack, *handlers = struct.unpack_from("<42I", image, 256)
    assert stack == RAM_END
    assert stack % 8 == 0
    assert stack - symbols["bss_end"] >= STACK_MIN
    named = {
        0: "reset",
        1: "halt",
        2: "halt",
        14: "systick_isr",
        15: "timer_isr",
        15 + 13: "trigger_isr",
        15 + 20: "uart_isr",
    }
    assert {k: handlers[k] for k in named} == {k: symbols[name] | 1 for k, name in named.items()}
    assert all(handler in (0, symbols["halt"] | 1) for k, handler in enumerate(handlers) if k not in named)


def test_everything_that_runs_in_time_stands_in_ram(symbols):
    in_flash = {name for name, address in symbols.items() if FLASH <= address < FLASH + IMAGE_MAX}
    assert in_flash - {"$t", "$d"} <= {"boot2", "reset", "halt", "vectors", "data_stored"}
    for name in ("main", "board_tick", "systick_isr", "timer_isr", "uart_isr", "memcpy", "memset"):
        assert RAM <= symbols[name] < RAM_END


def test_image_is_small_and_has_no_heap_and_no_printf(image, symbols):
    assert 4 * 1024 < len(image) < IMAGE_MAX
    assert not [name for name in symbols if FORBIDDEN.fullmatch(name)]


def check_uf2(folder, family):
    """Check that the UF2 file of a build holds its image, for the chip of a family."""
    content, image = (folder / "board.uf2").read_bytes(), (folder / "board.bin").read_bytes()
    assert len(content) % 512 == 0
    blocks = [Block(*struct.unpack_from("<8I476sI", content, at)) for at in range(0, len(content), 512)]
    for number, block in enumerate(blocks):
        assert block[:3] == (0x0A324655, 0x9E5D5157, 0x2000)
        assert (block.address, block.size) == (FLASH + 256 * number, 256)
        assert (block.number, block.count, block.family, block.last) == (number, len(blocks), family, 0x0AB16F30)
    joined = b"".join(block.data[:256] for block in blocks)
    assert joined[: len(image)] == image
    assert not any(joined[len(image) :])
    assert len(joined) - len(image) < 256


def test_uf2_says_the_same_as_the_image(build):
    check_uf2(build, 0xE48BFF56)


def test_the_image_of_the_pico_2_is_one_that_its_rom_takes(build_2350):
    check_uf2(build_2350, 0xE48BFF59)
    image, symbols = (build_2350 / "board.bin").read_bytes(), read_symbols(build_2350 / "board.elf")
    stack, *handlers = struct.unpack_from("<68I", image)
    assert stack == RAM + 520 * 1024
    named = {0: "reset", 2: "halt", 14: "systick_isr", 15: "timer_isr", 15 + 33: "uart_isr"}
    assert {k: handlers[k] for k in named} == {k: symbols[name] | 1 for k, name in named.items()}
    assert image.index(struct.pack("<I", 0xFFFFDED3)) < 4096
    assert RAM <= symbols["board_tick"] < RAM + 520 * 1024


def test_a_second_stage_that_is_too_long_is_refused(tmp_path):
    wrong = tmp_path / "wrong.bin"
    wrong.write_bytes(bytes(range(256)))
    command = [sys.executable, PORT / "image.py", "rp2040", wrong, tmp_path / "wrong.uf2"]
    reported = subprocess.run(command, capture_output=True, text=True)
    assert (reported.returncode, reported.stderr.count("\n")) == (2, 1)
    assert "fcfdfeff in its last four bytes, expected zeros" in reported.stderr
    assert not (tmp_path / "wrong.uf2").exists()
