"""The packages that README's commands install exist for the processors of small hosts."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GLIBC = (17, 24, 26, 27, 28, 31, 34, 35, 36)
"""Minor versions of glibc that Debian 12's pip accepts in the names of wheels."""
RESOLVE = """
import sys
from unittest.mock import patch
from pip._internal.cli.main import main
from pip._vendor.packaging import markers
known = markers.default_environment
with patch.object(markers, "default_environment", lambda: {**known(), "platform_machine": "aarch64"}):
    sys.exit(main(sys.argv[1:]))
"""
"""pip evaluates markers for the computer that it runs on, not for that of `--platform`."""


def list_requirements():
    """Return what `pip install .[dev]` requires, extras of this package followed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (own,) = (each for each in extras["dev"] if each.startswith("optodrive["))
    named = ["dev", *own.removeprefix("optodrive[").removesuffix("]").split(",")]
    return [*project["dependencies"], *(each for name in named for each in extras[name] if each != own)]


@pytest.mark.slow
def test_every_package_of_the_commands_has_a_wheel_for_aarch64(tmp_path):
    """pip resolves them, with all that they require, for CPython 3.11 of Debian 12 on a Raspberry Pi."""
    options = ["install", "--dry-run", "--only-binary=:all:", "--python-version=3.11", f"--target={tmp_path}"]
    options += [f"--platform=manylinux_2_{minor}_aarch64" for minor in GLIBC] + ["--platform=manylinux2014_aarch64"]
    command = [sys.executable, "-c", RESOLVE, *options, *list_requirements()]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    installed = done.stdout.split("Would install")[1]
    assert "numba" in installed
    assert "evdev" not in installed
