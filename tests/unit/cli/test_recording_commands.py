"""`optodrive recording convert | show`."""

import json

import h5py
import numpy as np
import pytest
from PIL import Image

from optodrive.cli.main import run
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import read_recording, show, write_recording
from recording_samples import assert_same, recording

ONE = recording().runs[0]


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "r.h5"
    write_recording(path, recording())
    return path


def test_convert_there_and_back(path, tmp_path, capsys):
    assert run(["recording", "convert", str(path), str(tmp_path / "folder")]) == 0
    assert f"written          {tmp_path / 'folder'}" in capsys.readouterr().out
    assert run(["recording", "convert", str(tmp_path / "folder"), str(tmp_path / "again.h5"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer == {"written": str(tmp_path / "again.h5"), "runs": 2, "samples": 404}
    assert_same(read_recording(tmp_path / "again.h5"), read_recording(path))


def test_show_prints_a_row_for_each_signal(path, capsys):
    assert run(["recording", "show", str(path)]) == 0
    page, _, table = capsys.readouterr().out.partition("\n\n")
    assert page.splitlines()[0] == "Nothing is left out."
    assert "displacement_m: 101 samples in 1 run at 1000 Hz, 2.0% of them missing." in page
    lines = [line.split() for line in table.splitlines()]
    assert lines[0] == ["run", "group", "pulses", "energy", "signal", "pixel", "samples", "missing", "span"]
    energy = ["55.67", "mJ"]
    assert lines[1][:5] == ["run2", "a", "2", *energy]
    assert lines[1][5:] == ["absorber_temperature_K", "17", "101", "0", "0", "to", "0.1", "s"]
    assert lines[2] == ["displacement_m", "17", "101", "2", "0", "to", "0.1", "s"]
    assert lines[3][0] == "run10"
    assert lines[3][-7:] == ["mirror_x_rad", "101", "0", "-0.01", "to", "0.09", "s"]


def test_show_cuts_no_name_short(tmp_path, capsys):
    name = "a-name-" * 25
    write_recording(tmp_path / "r.h5", Measurement((Run(name, 293.0, ONE.pulses, ONE.signals),)))
    assert run(["recording", "show", str(tmp_path / "r.h5")]) == 0
    out = capsys.readouterr().out
    assert name in out
    assert "0 to 0.1 s" in out


def test_show_as_json_is_one_object(path, tmp_path, capsys):
    out = tmp_path / "signals.png"
    assert run(["recording", "show", str(path), "--json", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "Infinity" not in text
    document = json.loads(text)
    assert document["recording"] == str(path)
    assert document["picture"] == {"file": str(out), "runs": 2}
    first = document["runs"][0]
    assert (first["run"], first["group"], first["pulsed_pixels"]) == ("run2", "a", [17, 18])
    assert first["energy_J"] == pytest.approx(0.02 * (2.45 + 1 / 3))
    assert first["signals"]["displacement_m"]["missing"] == 2
    assert document["runs"][1]["commands"] == 11


def test_the_picture_shows_pulses_curves_and_what_is_missing(path, tmp_path):
    out = tmp_path / "signals.PNG"
    assert run(["recording", "show", str(path), "--out", str(out)]) == 0
    with Image.open(out) as image:
        colours = {colour for _, colour in image.convert("RGB").getcolors(100_000)}
    for expected in (show.PULSE_COLOUR, show.CURVE_COLOUR, show.MISSING_COLOUR):
        assert tuple(bytes.fromhex(expected[1:])) in colours


def test_the_picture_takes_any_finite_numbers(tmp_path):
    largest = np.finfo(np.float64).max
    t_s = np.array([-largest, 0.0, 1.0, largest])
    signals = {
        "force_N": Signal(1, t_s, np.array([largest, np.nan, -largest, 0.0])),
        "displacement_m": Signal(1, t_s, np.full(4, 5e-324)),
    }
    pulses = np.array([[0.0, largest, largest, 1.0]])
    runs = tuple(Run(f"ламбда{k}", 293.0, pulses, signals, {"group": "g" * 99}) for k in range(401))
    write_recording(tmp_path / "r.h5", Measurement(runs[:2]))
    assert run(["recording", "show", str(tmp_path / "r.h5"), "--out", str(tmp_path / "p.png")]) == 0
    assert show.write_plot(tmp_path / "all.png", Measurement(runs)) == 400
    with Image.open(tmp_path / "all.png") as image:
        assert image.height < 20_000


def nan_times(path):
    with h5py.File(path, "r+") as file:
        file["runs/run2/displacement_m/t_s"][5] = np.nan


def truncated(path):
    path.write_bytes(path.read_bytes()[:3000])


@pytest.mark.parametrize("damage", [nan_times, truncated, lambda path: path.unlink()])
@pytest.mark.parametrize(
    "arguments", [["show"], ["show", "--json"], ["show", "--out", "OUT.png"], ["convert", "OUT"], ["convert", "OUT.h5"]]
)
def test_bad_input_is_one_line_status_2_and_nothing_written(path, tmp_path, capsys, damage, arguments):
    damage(path)
    before = sorted(tmp_path.rglob("*"))
    command, *rest = [word.replace("OUT", str(tmp_path / "out")) for word in arguments]
    assert run(["recording", command, str(path), *rest]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith(f"optodrive: {path}")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("out", ["plot.jpg", "picture", "nowhere/plot.png"])
def test_a_picture_that_cannot_be_written_is_refused(path, tmp_path, capsys, out):
    assert run(["recording", "show", str(path), "--out", str(tmp_path / out)]) == 2
    assert capsys.readouterr().out == ""
    assert list(tmp_path.iterdir()) == [path]
