"""The distributions: equal bits from one source, all contents, and the daemon from the wheel outside the checkout."""

import json
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "scripts"))

from release import build_twice, find_differences  # noqa: E402 - a script


def made(tmp_path, *options):
    command = [sys.executable, ROOT / "scripts" / "wheel.py", "--out", tmp_path, *options]
    finished = subprocess.run(command, text=True, capture_output=True)
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout.splitlines()[-1])


@pytest.mark.timeout(300)
def test_two_builds_are_equal_and_everything_is_inside(tmp_path):
    source, wheel = sorted(build_twice(tmp_path), key=lambda path: path.suffix)
    with tarfile.open(source) as archive:
        listed = {name.partition("/")[2] for name in archive.getnames()}
    assert {"LICENSE", "SECURITY.md", "scripts/release.py", "tests/system/test_wheel.py"} <= listed
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    folders = ("configs", "docs", "firmware_protocol")
    files = (path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file())
    shipped = {path.relative_to(ROOT).as_posix() for path in files if "__pycache__" not in path.parts}
    assert {"docs/how-to/wire-a-board.md", "firmware_protocol/ports/rp2040/main.c"} <= shipped
    assert {f"optodrive/_shipped/{path}" for path in shipped} <= inside
    own = {path.relative_to(ROOT).as_posix() for path in (ROOT / "optodrive").rglob("*") if path.is_file()}
    assert {path for path in own if "__pycache__" not in path} <= inside  # modules, the page, py.typed
    assert not [path for path in inside if path.startswith(("tests", "scripts", "firmware"))]


def test_a_build_that_differs_is_found():
    assert find_differences({"a": "1", "b": "2"}, {"a": "1", "b": "2"}) == []
    assert find_differences({"a": "1", "b": "2"}, {"a": "1", "b": "3", "c": "4"}) == ["b", "c"]


@pytest.mark.slow  # its kernels are compiled anew, too
@pytest.mark.timeout(300)
def test_the_daemon_runs_from_the_wheel(tmp_path):
    """Libraries are lent by this environment. The next test installs them too."""
    assert made(tmp_path, "--quick")["display"] == "display-16"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_empty_environment_gets_all_it_needs_from_the_index(tmp_path):
    assert made(tmp_path)["planned"] == 1
