"""Builds of the firmware's ports outside the source tree, and their commands."""

import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

PORTS = Path(__file__).parents[1] / "firmware_protocol" / "ports"
sys.path.append(str(PORTS / "mps2-an385"))

from emulated_chip import EmulatedChip  # noqa: E402

PACKAGES = {
    "gcc": "gcc libc6-dev",
    "make": "make",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
    "node": "nodejs npm",
    "ngspice": "ngspice",
    "clang": "clang",
    "cppcheck": "cppcheck",
}
NEEDS = {"host": ("gcc", "make"), "mps2-an385": ("arm-none-eabi-gcc", "qemu-system-arm", "make")}


def require(*tools):
    """Raise AssertionError with the Debian packages of missing tools."""
    missing = [PACKAGES[tool] for tool in tools if shutil.which(tool) is None]
    assert not missing, f"the firmware's tests need: apt-get install {' '.join(missing)}"


def _build(folder, mutant, port):
    """Build a port. Return its file without suffix.

    mutant: number of the disabled guard
    """
    require(*NEEDS[port])
    build = ["make", "-s", "-C", PORTS / port, f"BUILD={folder}", f"MUTANT={mutant}"]
    built = subprocess.run(build, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return folder / (f"board-{mutant}" if mutant else "board")


def build_board(folder, mutant=0, port="host"):
    """Build a port and return its command without options."""
    program = _build(folder, mutant, port)
    if port == "host":
        return (str(program),)
    return (sys.executable, str(PORTS / port / "board.py"), "--image", f"{program}.elf")


def build_emulated_chip(folder, mutant=0):
    """Build the image of the emulated Cortex-M3. Return a function of settings, sink and seed for a chip."""
    return partial(EmulatedChip, _build(folder, mutant, "mps2-an385").with_suffix(".elf"))
