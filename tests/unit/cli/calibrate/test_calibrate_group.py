"""`optodrive calibrate`: every subcommand accepts its own options only."""

import os
import subprocess
import sys
from io import StringIO

import pytest

from optodrive.cli.main import run


def test_without_a_subcommand_the_help_lists_all(capsys):
    assert run(["calibrate"]) == 2
    output = capsys.readouterr().out
    names = ("field", "camera", "board", "steps", "servo", "sweep", "pixels", "power", "film")
    assert all(f" {name} " in output for name in names)


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["--spots", "spots.csv"], "--spots"),
        (["field", "spots.csv", "--manual"], "--manual"),
        (["camera", "folder", "--model", "model.toml"], "--model"),
        (["board", "--spots", "spots.csv"], "--spots"),
        (["servo", "recording.h5", "--report", "report.html"], "--report"),
        (["pixels", "recording.h5", "--readings", "3"], "--readings"),
    ],
)
def test_an_option_of_another_subcommand_is_an_unknown_option(capsys, arguments, option):
    assert run(["calibrate", *arguments]) == 2
    error = capsys.readouterr().err
    assert f"No such option: {option}" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("option", "value"), [("--target-rms-um", "0"), ("--spots-max", "8"), ("--readings", "101")])
def test_a_number_out_of_range_is_named_before_the_board_is_opened(capsys, option, value):
    assert run(["calibrate", "board", option, value]) == 2
    assert capsys.readouterr().err.startswith(f"optodrive: {option}: got {value}")


def test_without_a_terminal_emission_needs_yes(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", StringIO("y\n"))
    assert run(["calibrate", "board"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("optodrive: --yes: missing, expected --yes, because without a terminal nobody can confirm")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_no_on_the_terminal_ends_before_the_board_is_opened(monkeypatch, tmp_path):
    master, terminal = os.openpty()
    command = [sys.executable, "-m", "optodrive.cli.main", "calibrate", "board"]
    with subprocess.Popen(command, cwd=tmp_path, stdin=terminal, stderr=subprocess.PIPE, text=True) as process:
        os.write(master, b"n\n")
        _, errors = process.communicate()
    os.close(terminal)
    os.close(master)
    assert process.returncode == 130
    assert "this arms the board, lights up to 25 places with a spot of 5 mW, and writes field.toml. Continue?" in errors
    assert list(tmp_path.iterdir()) == []
