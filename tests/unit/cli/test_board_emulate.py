"""`optodrive board emulate`: one line for what is missing, and for an image or a port that it cannot use."""

import json
import sys
from pathlib import Path

import pytest

from optodrive.cli.main import run
from optodrive.link.simulator.emulated_pico import PACKAGE, VERSION

sys.path.append(str(Path(__file__).parents[3] / "firmware_protocol" / "ports" / "rp2040"))

from image import FAMILIES, build_uf2


@pytest.fixture
def tools(tmp_path, monkeypatch):
    """Return a folder of programs, the only one on PATH, with those that are needed."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("node", "cc"):
        (folder / name).write_text("#!/bin/sh\nexit 1\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))
    return folder


@pytest.fixture
def emulate(tmp_path, tools, capsys):
    """Return a function that emulates an image and returns the exit status and stderr."""

    def emulate(chip="rp2040", version=VERSION, port="pico"):
        image, package = tmp_path / "board.uf2", tmp_path / "node_modules" / PACKAGE
        image.write_bytes(build_uf2(bytes(range(256)) * 3, FAMILIES[chip]))
        package.mkdir(parents=True, exist_ok=True)
        (package / "package.json").write_text(json.dumps({"version": version}))
        status = run(["board", "emulate", str(image), "--port", str(tmp_path / port), "--modules", str(tmp_path)])
        return status, capsys.readouterr().err

    return emulate


def test_what_is_missing_is_named_with_its_package(emulate, tools, tmp_path):
    install = f"expected npm install --prefix {tmp_path} rp2040js@{VERSION}\n"
    assert emulate(version="0.19.4") == (2, f"optodrive: --modules: got rp2040js 0.19.4, {install}")
    assert emulate(version=None)[1].endswith(install)
    (tmp_path / "node_modules" / PACKAGE / "package.json").unlink()
    (tools / "cc").unlink()
    assert emulate() == (2, "optodrive: PATH: got no emulator, expected Debian's gcc libc6-dev\n")
    (tools / "node").unlink()
    assert "Debian's nodejs npm gcc libc6-dev" in emulate()[1]


def test_another_chip_or_a_port_that_is_a_file_is_refused(emulate, tmp_path):
    assert "got an image for the RP2350, expected one for the RP2040" in emulate(chip="rp2350")[1]
    (tmp_path / "pico").write_text("mine")
    assert "--port: got " in emulate()[1]
    assert (tmp_path / "pico").read_text() == "mine"
    assert "folder that exists" in emulate(port="none/pico")[1]
    status, error = emulate(port="other")
    assert (status, error.count("\n")) == (1, 1)
    assert "cc ended with 1" in error
