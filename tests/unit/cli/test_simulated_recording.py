"""`optodrive simulate --repeats N --group NAME`: repeats of one experiment in one recording."""

import json

import numpy as np
import pytest

from optodrive.cli.main import run
from optodrive.lab.diagnosis.dataset import build_dataset
from optodrive.lab.recording import read_recording


@pytest.fixture
def frames(tmp_path):
    path = tmp_path / "frames.json"
    path.write_text(json.dumps({"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"3": 50, "4": 80}}]}))
    return str(path)


@pytest.fixture
def simulate(frames, tmp_path, capsys):
    """Return a function that simulates into a new recording and returns its runs and the output."""

    def simulate(*options):
        out = tmp_path / "recording.h5"
        out.unlink(missing_ok=True)
        assert run(["simulate", frames, "--config", "display-16", "--out", str(out), *options]) == 0
        return read_recording(out), capsys.readouterr().out

    return simulate


def test_repeats_have_one_group_and_their_own_noise(simulate):
    measurement, shown = simulate("--repeats", "3", "--group", "weak", "--pixels", "4")
    assert [item.name for item in measurement.runs] == [f"pixel-4-repeat-{number}" for number in (1, 2, 3)]
    assert {item.attributes["group"] for item in measurement.runs} == {"weak"}
    values = [item.signals["displacement_m"].value for item in measurement.runs]
    assert np.std(values[0] - values[1]) == pytest.approx(2**0.5 * 0.25e-6, rel=0.2)
    assert np.std(values[1] - values[2]) == pytest.approx(2**0.5 * 0.25e-6, rel=0.2)
    assert "repeats          3 of every run, each with its own noise" in shown
    once, _ = simulate("--pixels", "4")
    assert "group" not in once.runs[0].attributes
    assert np.array_equal(once.runs[0].signals["displacement_m"].value, values[0])


def test_different_pixels_never_repeat_each_other(simulate):
    measurement, _ = simulate("--repeats", "2", "--group", "weak")
    data = build_dataset(measurement)
    assert {name: len(runs) for name, runs in data.groups.items()} == {"weak, pixel 3": 2, "weak, pixel 4": 2}
    assert data.contrast_count == 2


def test_without_a_name_repeats_share_a_group_and_one_run_may_have_a_name(simulate):
    assert [item.attributes["group"] for item in simulate("--repeats", "2", "--pixels", "3")[0].runs] == [
        "simulated"
    ] * 2
    named, shown = simulate("--group", "weak", "--pixels", "3")
    assert [(item.name, item.attributes["group"]) for item in named.runs] == [("pixel-3", "weak")]
    assert "\nrepeats " not in shown


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--repeats", "0", "--out", "r.h5"], "--repeats: got 0, expected a number from 1 to 100"),
        (["--repeats", "2"], "--repeats: got 2, expected --out, the recording of the repeats"),
        (["--group", "a"], "--group: got 'a', expected --out, the recording of the group"),
        (["--group", "", "--out", "r.h5"], "--group: got '', expected 1 to 200 printable characters"),
    ],
)
def test_settings_without_effect_are_refused(frames, options, expected, capsys):
    assert run(["simulate", frames, *options]) == 2
    assert capsys.readouterr().err == f"optodrive: {expected}\n"


def test_pixels_that_are_not_recorded_by_default_are_counted(tmp_path, capsys):
    path = tmp_path / "all.json"
    path.write_text(json.dumps({"frames": [{"show_at_s": 0.0, "duration_s": 2.0, "target_um": [50.0] * 437}]}))
    assert run(["simulate", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "\nrecorded         16 of 437 driven pixels; --pixels names others, or all\n" in shown
    assert shown.count("measured") == 16
    assert run(["simulate", str(path), "--pixels", "3,4"]) == 0
    assert "driven pixels" not in capsys.readouterr().out
