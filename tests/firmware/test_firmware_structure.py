"""No two C files need each other: functions and data by the compilers' symbols, headers by their includes."""

import re
import shutil
import subprocess
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from firmware_ports import require

FIRMWARE = Path(__file__).parents[2] / "firmware_protocol"
PORTS = {
    "host": ("gcc", [], ["ports/host"]),
    "mps2-an385": ("arm-none-eabi-gcc", ["-mcpu=cortex-m3"], ["ports/arm", "ports/mps2-an385"]),
    "rp2040": ("arm-none-eabi-gcc", ["-mcpu=cortex-m0plus"], ["ports/arm", "ports/rp2040"]),
}
"""Compiler, flags, and folders besides the core."""


def list_needs(port, firmware, folder):
    """Compile a port in a folder. Return the object files whose symbols each object file needs."""
    compiler, flags, folders = PORTS[port]
    require(compiler)
    paths = [firmware / name for name in ("core", *folders)]
    sources = [source for path in paths for source in sorted(path.glob("*.c"))]
    subprocess.run([compiler, *flags, "-c", *(f"-I{path}" for path in paths), *sources], cwd=folder, check=True)
    listed = subprocess.run(["nm", "-A", *sorted(folder.glob("*.o"))], capture_output=True, text=True, check=True)
    symbols = [(*line.split(":")[0:1], *line.split()[-2:]) for line in listed.stdout.splitlines()]
    assert {Path(owner).stem for owner, *_ in symbols} == {source.stem for source in sources}
    owners = {name: owner for owner, kind, name in symbols if kind.isupper() and kind != "U"}
    needs = {owner: set() for owner in owners.values()}
    for owner, kind, name in symbols:
        if kind == "U" and name in owners:
            needs.setdefault(owner, set()).add(owners[name])
    return needs


def check_order(needs):
    """Raise CycleError if two of the files need each other."""
    TopologicalSorter(needs).prepare()


@pytest.mark.parametrize("port", PORTS)
def test_no_two_files_need_each_other(port, tmp_path):
    needs = list_needs(port, FIRMWARE, tmp_path)
    assert len(needs) > 10
    check_order(needs)


def test_a_chip_that_calls_the_main_program_is_detected(tmp_path):
    wrong, objects = tmp_path / "firmware", tmp_path / "objects"
    shutil.copytree(FIRMWARE, wrong)
    objects.mkdir()
    chip, main = (wrong / "ports" / "rp2040" / name for name in ("chip.c", "main.c"))
    chip.write_text("void on_alarm(void);\n" + chip.read_text().replace("    alarm_callback();", "    on_alarm();"))
    main.write_text(main.read_text().replace("static void on_alarm(void)", "void on_alarm(void)"))
    with pytest.raises(CycleError, match=r"chip\.o.*main\.o|main\.o.*chip\.o"):
        check_order(list_needs("rp2040", wrong, objects))


@pytest.mark.parametrize("port", PORTS)
def test_no_two_headers_include_each_other(port):
    headers = [header for name in ("core", *PORTS[port][2]) for header in (FIRMWARE / name).glob("*.h")]
    check_order({header.name: set(re.findall(r'#include "([^"]+)"', header.read_text())) for header in headers})
