"""Recordings as a folder of CSV files: round trips, and errors specific to this form."""

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.lab.recording import csv_folder, read_recording, storage, write_recording
from recording_samples import assert_same, recording


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "recording"
    write_recording(folder, recording(), "a camera")
    return folder


def test_what_is_written_is_read_again(folder):
    assert_same(read_recording(folder), recording())


def test_the_folder_is_laid_out_as_documented(folder):
    files = sorted(str(path.relative_to(folder)) for path in folder.rglob("*.csv"))
    assert files == [
        "run10/commands.csv",
        "run10/mirror_x_rad.csv",
        "run10/mirror_y_rad.csv",
        "run10/pulses.csv",
        "run2/absorber_temperature_K.csv",
        "run2/displacement_m.csv",
        "run2/pulses.csv",
    ]
    pulses = (folder / "run2/pulses.csv").read_text().splitlines()
    assert pulses == ["start_s,width_s,power_W,pixel", "0.0,0.02,2.45,17", "0.05,0.02,0.3333333333333333,18"]
    assert (folder / "run2/displacement_m.csv").read_text().splitlines()[4] == "0.003,"
    assert folder.stat().st_mode & 0o777 == 0o755


def test_a_folder_made_by_hand_is_read(tmp_path):
    (tmp_path / "recording.toml").write_text(
        """
        format = "optotactile-recording"
        version = 1
        [runs.first]
        ambient_K = 293
        started_at = 2024-05-01T12:00:00
        tags = ["a", "b"]
        [runs.first.force_N]
        pixel = 3
        """
    )
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "pulses.csv").write_text("\ufeffstart_s, width_s, power_W, pixel\r\n0, 1e-2, 2, 3\r\n\r\n")
    (tmp_path / "first" / "force_N.csv").write_text('t_s,value\n0,"1.5"\n1,\n2, nan \n3,1\n4,1\n5,1\n6,1\n7,1')
    (tmp_path / "first" / "._force_N.csv").write_text("what another system leaves behind")
    (run,) = read_recording(tmp_path).runs
    assert (run.ambient_k, run.attributes) == (293.0, {"started_at": "2024-05-01T12:00:00"})
    assert run.pulses.tolist() == [[0.0, 0.01, 2.0, 3.0]]
    assert np.array_equal(run.signals["force_N"].value, [1.5, np.nan, np.nan, 1, 1, 1, 1, 1], equal_nan=True)


def text(name, old, new):
    def damage(folder):
        path = folder / name
        content = path.read_text(encoding="utf-8")
        assert old in content
        path.write_text(content.replace(old, new, 1), encoding="utf-8")

    return damage


def content(name, data):
    return lambda folder: (folder / name).write_bytes(data)


def gone(name):
    return lambda folder: (folder / name).unlink()


def renamed(old, new):
    return lambda folder: (folder / old).rename(folder / new)


def forgotten(folder):
    (folder / "extra").mkdir()
    (folder / "extra" / "pulses.csv").write_text("start_s,width_s,power_W,pixel\n")


HEIGHT = "run2/displacement_m.csv"
REFUSALS = {
    "no description": (gone("recording.toml"), ["recording.toml: got no file of this name, ", "TOML"]),
    "no TOML": (text("recording.toml", "version = 1", "version 1"), ["recording.toml", "TOML", "line 2"]),
    "no text": (content("recording.toml", b"\xff\xfe\x00"), ["recording.toml", "TOML"]),
    "format": (text("recording.toml", "optotactile", "opto"), ["format", "'opto-recording'"]),
    "version": (text("recording.toml", "version = 1", "version = 2"), ["version", "2"]),
    "runs no table": (content("recording.toml", b'format="optotactile-recording"\nversion=1\nruns=3'), ["runs", "3"]),
    "no runs": (content("recording.toml", b'format="optotactile-recording"\nversion=1'), ["runs", "[runs.NAME]"]),
    "way out": (text("recording.toml", "[runs.run2]", '[runs."../x"]'), ["'../x'", "printable"]),
    "run forgotten": (forgotten, ["/runs/extra: ambient_K"]),
    "no ambient": (text("recording.toml", "ambient_K", "ambient"), ["/runs/run2: ambient_K"]),
    "no pixel": (text("recording.toml", "pixel = 17", ""), ["/runs/run2/absorber_temperature_K: pixel"]),
    "sigma misspelt": (text("recording.toml", "sigma =", "sigam ="), ["'sigam'", "nearest is 'sigma'"]),
    "another width": (text("recording.toml", "bridge_width_m", "bridge_width_um"), ["nearest is 'bridge_width_m'"]),
    "pixel a date": (text("recording.toml", "pixel = 17", "pixel = 2024-01-01"), ["temperature_K: pixel", "'2024-"]),
    "unknown table": (text("recording.toml", "displacement_m]", "displacement_mm]"), ["nearest is 'displacement_m'"]),
    "unknown file": (
        renamed("run2/absorber_temperature_K.csv", "run2/absorber_temperature_C.csv"),
        ["/runs/run2/absorber_temperature_C", "nearest is 'absorber_temperature_K'"],
    ),
    "no pulses": (gone("run2/pulses.csv"), ["/runs/run2/pulses", "one row per pulse"]),
    "no signal file": (gone(HEIGHT), ["/runs/run2/displacement_m", "the file run2/displacement_m.csv"]),
    "header": (text(HEIGHT, "t_s,value", "t_min,value"), ["displacement_m: first line", "'t_min'", "a column t_s too"]),
    "two values": (text(HEIGHT, "t_s,value", "t_s,value,displacement_mm"), ["got 'value' and 'displacement_mm'"]),
    "semicolons": (text("run2/pulses.csv", ",", ";"), ["pulses: first line", "a column start_s too"]),
    "no header": (content(HEIGHT, b""), ["displacement_m: first line", "an empty line"]),
    "no rows": (content(HEIGHT, b"t_s,value\n"), ["displacement_m", "no samples"]),
    "three cells": (text(HEIGHT, "0.003,", "0.003,1,2"), ["displacement_m: row 5", "3 cells", "2 cells, as in"]),
    "a word": (text(HEIGHT, "0.003,", "0.003,high"), ["displacement_m: row 5: value", "'high'", "a number"]),
    "a decimal comma": (text("run2/pulses.csv", "2.45", "2,45"), ["pulses: row 2", "5 cells"]),
    "time missing": (text(HEIGHT, "0.003,", ",1e-6"), ["displacement_m: row 5: t_s", "''"]),
    "time NaN": (text(HEIGHT, "0.003,", "nan,"), ["displacement_m/t_s[3]", "nan"]),
    "time backwards": (text(HEIGHT, "0.003,", "0.001,"), ["displacement_m/t_s[3]", "increasing"]),
    "infinite": (text(HEIGHT, "0.003,", "0.003,inf"), ["displacement_m/value[3]", "inf"]),
    "pulse missing": (text("run2/pulses.csv", "2.45", ""), ["pulses: row 2: power_W", "''"]),
    "pulses overlap": (text("run2/pulses.csv", "0.05", "0.01"), ["pulses[1]: start_s", "the beam"]),
    "commands repeat": (text("run10/commands.csv", "0.01,", "0.0,"), ["/runs/run10/commands: t_s[1]", "increasing"]),
    "NUL": (content(HEIGHT, b"t_s,value\n0,\0\n"), ["displacement_m"]),
    "other bytes": (content(HEIGHT, b"t_s,value\n\xff\xfe"), ["displacement_m", "CSV"]),
    "an endless cell": (content(HEIGHT, b't_s,value\n0,"' + b"1" * 200_000), ["displacement_m", "CSV"]),
}


@pytest.mark.parametrize("kind", REFUSALS)
def test_refused_in_one_line_that_names_the_place(kind, folder):
    damage, words = REFUSALS[kind]
    damage(folder)
    with pytest.raises(InputError) as caught:
        read_recording(folder)
    message = str(caught.value)
    assert message.startswith(str(folder))
    assert "\n" not in message
    for word in words:
        assert word in message


def test_too_many_numbers_are_refused_while_they_are_counted(folder, monkeypatch):
    monkeypatch.setattr(csv_folder, "MemoryBudget", lambda: storage.MemoryBudget(100))
    with pytest.raises(InputError, match="at most"):
        read_recording(folder)


def test_what_is_there_already_stays(folder):
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    with pytest.raises(InputError, match="new or empty"):
        write_recording(folder, recording())
    (folder.parent / "file").write_text("x")
    with pytest.raises(InputError, match="new or empty"):
        write_recording(folder.parent / "file", recording())
    with pytest.raises(InputError, match="writable"):
        write_recording(folder.parent / "nowhere" / "recording", recording())
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    assert sorted(path.name for path in folder.parent.iterdir()) == ["file", "recording"]


def test_an_empty_folder_is_filled(tmp_path):
    (tmp_path / "empty").mkdir()
    write_recording(tmp_path / "empty", recording())
    assert len(read_recording(tmp_path / "empty").runs) == 2


def test_nothing_is_left_where_writing_fails_halfway(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(csv_folder, "_write_csv", fail)
    with pytest.raises(InputError, match="No space left"):
        write_recording(tmp_path / "recording", recording())
    assert not list(tmp_path.iterdir())
