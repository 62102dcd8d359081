"""Outputs of commands: every path is checked before anything is read or computed, by its folder and its suffix."""

from pathlib import Path

import pytest

from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.core.files import check_output, create_folder

WRITERS = {
    "diagnose --out": (["diagnose", "absent.h5", "--out"], None),
    "diagnose --json": (["diagnose", "absent.h5", "--json"], ".json"),
    "simulate": (["simulate", "absent.json", "--out"], ".h5"),
    "plan": (["plan", "absent.json", "--out"], ".csv"),
    "recording convert": (["recording", "convert", "absent.h5"], ".h5"),
    "recording show": (["recording", "show", "absent.h5", "--out"], ".png"),
    "recording trials": (["recording", "trials", "absent.h5", "--out"], ".csv"),
    "serve --record-session": (["serve", "--config", "absent.toml", "--record-session"], ".h5"),
    "recording merge": (["recording", "merge", "absent.h5", "absent.h5", "--out"], ".h5"),
    "field": (["field", "--calibration", "absent.toml", "--points", "absent.csv", "--out"], ".csv"),
    "field --import": (["field", "--import", "absent.cor", "--out"], ".toml"),
    "calibrate field": (["calibrate", "field", "absent.csv", "--out"], ".toml"),
    "calibrate field --report": (["calibrate", "field", "absent.csv", "--report"], ".html"),
    "calibrate camera": (["calibrate", "camera", "absent", "--out"], ".toml"),
    "calibrate servo": (["calibrate", "servo", "absent.h5", "--out"], ".toml"),
    "calibrate pixels": (["calibrate", "pixels", "absent.h5", "--out"], ".toml"),
    "calibrate pixels --sweep": (["calibrate", "pixels", "--config", "absent.toml", "--sweep"], None),
}
"""Commands on absent inputs, which only a check of the output comes before, and the suffix of the output."""


def _error(capsys, arguments):
    assert run(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    return error


@pytest.mark.parametrize("name", WRITERS)
def test_an_output_that_cannot_be_written_is_refused_before_the_input_is_read(name, tmp_path, capsys, monkeypatch):
    arguments, suffix = WRITERS[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    path = f"file/out{suffix or ''}"
    error = _error(capsys, [*arguments, path])
    assert path in error
    assert "absent" not in error


@pytest.mark.parametrize("name", [name for name, (_, suffix) in WRITERS.items() if suffix is not None])
def test_another_suffix_is_refused_before_the_input_is_read(name, tmp_path, capsys):
    arguments, suffix = WRITERS[name]
    for wrong in (".bmp", ".txt"):
        path = tmp_path / f"out{wrong}"
        assert suffix in _error(capsys, [*arguments, str(path)])
        assert not path.exists()


@pytest.mark.parametrize("name", WRITERS)
def test_nothing_is_overwritten(name, tmp_path, capsys):
    arguments, suffix = WRITERS[name]
    path = tmp_path / f"out{suffix or ''}"
    kept = path if suffix is not None else path / "report.html"
    kept.parent.mkdir(exist_ok=True)
    kept.write_text("mine")
    expected = "a new or empty folder" if suffix is None else "a new file; this one exists"
    assert _error(capsys, [*arguments, str(path)]).endswith(expected)
    assert kept.read_text() == "mine"


def test_an_interrupted_run_may_continue_in_its_folder(tmp_path):
    (tmp_path / "pulses.csv").write_text("")
    check_output("--out", tmp_path, folder=True, may_exist=True)
    with pytest.raises(InputError, match="a new or empty folder"):
        check_output("--out", tmp_path, folder=True)


def test_forms_of_an_output(tmp_path):
    check_output("--out", None, ".csv")
    check_output("--out", tmp_path / "a.CSV", ".csv")
    check_output("--out", tmp_path / "any")
    check_output("--out", tmp_path / "new" / "deep", folder=True)
    check_output("--out", tmp_path / "a.h5", ".h5", folder=True)
    check_output("--out", tmp_path / "day.2026", ".h5", folder=True)
    (tmp_path / "kept.csv").mkdir()
    (tmp_path / "link.csv").symlink_to("nowhere")
    check_output("--out", tmp_path / "kept.csv", ".h5", folder=True)
    for path, suffixes, folder in (
        (tmp_path / "a.csv", (".h5", ".hdf5"), True),
        (tmp_path / "kept.csv", (".csv",), False),
        (tmp_path / "link.csv", (".csv",), False),
        (tmp_path, (), False),
        (tmp_path / "no" / "a.csv", (".csv",), False),
        (tmp_path / "no" / "recording", (".h5",), True),
    ):
        with pytest.raises(InputError, match="--out"):
            check_output("--out", path, *suffixes, folder=folder)


def test_a_folder_that_cannot_be_created_is_refused_by_name():
    """Nothing can be created in /proc, whose permissions say otherwise."""
    with pytest.raises(InputError, match="/proc/new: got 'No such file or directory', expected a folder"):
        create_folder(Path("/proc/new"))
