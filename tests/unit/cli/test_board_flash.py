"""`optodrive board flash`: what it finds, what it writes, and one line for what it does not write."""

import struct
import sys
from pathlib import Path

import pytest

from optodrive.cli.main import run as run_command

sys.path.append(str(Path(__file__).parents[3] / "firmware_protocol" / "ports" / "rp2040"))

from image import FAMILIES, build_uf2

BLOCK_BYTES = 512


@pytest.fixture
def uf2(tmp_path):
    """Return a function that writes a UF2 file of three blocks."""

    def write(chip="rp2040", change=lambda content: content):
        path = tmp_path / "board.uf2"
        path.write_bytes(change(build_uf2(bytes(range(256)) * 3, FAMILIES[chip])))
        return path

    return write


@pytest.fixture
def mount(tmp_path):
    """Return a function that shows drives with a Board-ID as mounted, and the file that lists them."""
    listed = tmp_path / "mounts"
    listed.write_text("proc /proc proc rw 0 0\n")

    def add(board_id, name="RPI RP2"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "INFO_UF2.TXT").write_text(f"UF2 Bootloader v3.0\nModel: Raspberry Pi\nBoard-ID: {board_id}\n")
        with listed.open("a") as file:
            file.write(f"/dev/sdb1 {str(folder).replace(' ', chr(92) + '040')} vfat rw 0 0\n")
        return folder

    add.listed = listed
    return add


@pytest.fixture
def flash(mount, capsys, monkeypatch):
    """Return a function that flashes a file and returns exit status, stdout and stderr."""

    def run(path, tools=""):
        monkeypatch.setenv("PATH", str(tools))
        monkeypatch.setattr("optodrive.link.boot_loader.MOUNTS", mount.listed)
        status = run_command(["board", "flash", str(path)])
        return status, *capsys.readouterr()

    return run


@pytest.mark.parametrize(("chip", "board_id"), [("rp2040", "RPI-RP2"), ("rp2350", "RP2350")])
def test_the_file_is_copied_to_the_drive_of_its_chip(uf2, mount, flash, chip, board_id):
    path, drive = uf2(chip), mount(board_id)
    status, out, err = flash(path)
    assert (status, err) == (0, "")
    assert f"{path}: {chip.upper()}, 768 bytes of flash from 0x10000000" in out
    assert f"{drive}: {chip.upper()}, Board-ID {board_id}" in out
    assert (drive / path.name).read_bytes() == path.read_bytes()


def cut(content):
    return content[:-1]


def gap(content):
    return content[: BLOCK_BYTES + 12] + struct.pack("<I", 0x1000_0200) + content[BLOCK_BYTES + 16 :]


def foreign(content):
    return content.replace(struct.pack("<I", FAMILIES["rp2040"]), struct.pack("<I", 0x1234))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (cut, "got 1535 bytes, expected blocks of 512, of UF2"),
        (lambda content: b"", "got 0 bytes, expected blocks of 512, of UF2"),
        (
            lambda content: bytes(4) + content[4:],
            "got block 0 without the marks of UF2, expected its marks at begin and end",
        ),
        (lambda content: content[:BLOCK_BYTES], "got block 0 of 3, expected 0 of 1"),
        (gap, "got block 1 for 0x10000200, expected 0x10000100"),
        (foreign, "got family 0x1234, expected one of 0xe48bff56, 0xe48bff59"),
    ],
)
def test_a_damaged_file_is_not_written(uf2, mount, flash, change, says):
    path, drive = uf2(change=change), mount("RPI-RP2")
    status, _, err = flash(path)
    assert (status, err) == (2, f"optodrive: {path}: {says}\n")
    assert not (drive / path.name).exists()


def test_a_file_that_is_not_there_and_one_for_another_chip(uf2, mount, flash, tmp_path):
    drive = mount("RP2350")
    status, _, err = flash(uf2())
    assert status == 2
    assert "Board-ID: got RP2350, expected that of RP2040" in err
    assert not (drive / "board.uf2").exists()
    status, _, err = flash(tmp_path / "nothing.uf2")
    assert status == 2
    assert "nothing.uf2: got 'No such file or directory', expected a readable file" in err
    assert err.count("\n") == 1


def test_of_two_boards_neither_is_written(uf2, mount, flash):
    drives = [mount("RPI-RP2", name) for name in ("one", "other")]
    status, _, err = flash(uf2())
    assert status == 1
    assert f"2 boards: {drives[0]}, {drives[1]}; expected one" in err
    assert not any((drive / "board.uf2").exists() for drive in drives)


@pytest.mark.parametrize(("code", "said"), [(0, ""), (249, "No accessible RP-series devices in BOOTSEL mode")])
def test_without_a_drive_picotool_writes(uf2, flash, tmp_path, code, said):
    tools, path = tmp_path / "tools", uf2()
    tools.mkdir()
    (tools / "picotool").write_text(f'#!/bin/sh\necho "$@" > "{tools}/told"\necho "{said}"\nexit {code}\n')
    (tools / "picotool").chmod(0o755)
    status, _, err = flash(path, tools)
    assert (tools / "told").read_text() == f"load -v -x {path}\n"
    assert status == (1 if code else 0)
    assert err == (f"optodrive: picotool ended with 249 and said: {said}\n" if code else "")


def test_without_drive_and_picotool_it_says_what_to_do(uf2, flash):
    status, _, err = flash(uf2())
    assert status == 1
    assert "no drive with INFO_UF2.TXT is mounted, and no picotool in PATH: hold BOOTSEL" in err
