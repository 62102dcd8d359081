"""Core and Pico port in two static analysers, without a finding."""

import subprocess
from pathlib import Path

import pytest

from firmware_ports import require

FIRMWARE = Path(__file__).parents[2] / "firmware_protocol"
FOLDERS = [FIRMWARE / name for name in ("core", "ports/arm", "ports/rp2040")]
CHIPS = {"rp2040": "-URP2350", "rp2350": "-DRP2350"}
NOT_OF = {"rp2040": "image_def.c", "rp2350": "boot2.c"}
BY_DESIGN = ("comparePointers", "unusedStructMember", "unusedFunction")
"""Limits of memory are symbols of the linker; vectors are read, and entries called, by the chip."""


def list_sources(chip):
    return [path for folder in FOLDERS for path in sorted(folder.glob("*.c")) if path.name != NOT_OF[chip]]


def run_clang(sources, *flags):
    """Return what clang's analyser says of sources."""
    require("clang", "arm-none-eabi-gcc")
    target = ["--target=thumbv7m-none-eabi", "-ffreestanding", "-std=c11", "-isystem", "/usr/lib/arm-none-eabi/include"]
    includes = [f"-I{folder}" for folder in FOLDERS]
    command = ["clang", "--analyze", "-Xclang", "-analyzer-output=text", *target, *includes, "-DMUTANT=0", *flags]
    return subprocess.run([*command, *sources], capture_output=True, text=True).stderr


@pytest.mark.slow
@pytest.mark.parametrize("chip", CHIPS)
def test_clang_s_analyser_finds_nothing(chip):
    assert run_clang(list_sources(chip), CHIPS[chip]) == ""


@pytest.mark.parametrize("chip", CHIPS)
def test_cppcheck_finds_nothing(chip):
    require("cppcheck")
    suppressed = [f"--suppress={name}" for name in ("missingIncludeSystem", "unmatchedSuppression", *BY_DESIGN)]
    command = ["cppcheck", "--enable=all", "--std=c11", "--quiet", CHIPS[chip], "-DMUTANT=0", *suppressed]
    found = subprocess.run(
        [*command, *(f"-I{folder}" for folder in FOLDERS), *list_sources(chip)], capture_output=True, text=True
    )
    assert (found.returncode, found.stderr) == (0, "")


def test_a_pointer_that_is_not_there_is_found(tmp_path):
    wrong = tmp_path / "wrong.c"
    wrong.write_text("int get(const int *at) { return at ? 0 : *at; }\n")
    assert "Dereference of null pointer" in run_clang([wrong])
