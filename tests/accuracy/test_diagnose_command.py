"""`optodrive diagnose`, run as a command: text, files, JSON and wrong input."""

import json

import numpy as np
import pytest

from labs import lab
from optodrive.cli.main import run
from optodrive.core.types.measurements import Measurement, Run
from optodrive.device.config_file import locate_shipped
from optodrive.lab.recording import write_recording

DROOP = {"laser_droop": {"share": 0.08, "time": 0.05, "spread": 1.0}}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("lab") / "droop.h5"
    write_recording(path, lab(21, DROOP))
    return path


def test_a_recording_given_twice_is_refused(recording, capsys):
    assert run(["diagnose", str(recording), str(recording)]) == 2
    assert capsys.readouterr().err.strip().endswith("expected every recording once")


def test_the_narrative_and_three_files(recording, tmp_path, capsys):
    out = tmp_path / "answer"
    assert run(["diagnose", str(recording), "--out", str(out)]) == 0
    output = capsys.readouterr().out
    assert output.startswith("The nominal model is wrong because the laser's power falls while it is on.")
    assert sorted(path.name for path in out.iterdir()) == ["diagnosis.json", "model.toml", "report.html"]
    answer, report = json.loads((out / "diagnosis.json").read_text()), (out / "report.html").read_text()
    assert answer["causes"] == ["laser_droop"]
    provenance = answer["provenance"]
    assert provenance["command"] == f"optodrive diagnose {recording} --out {out}"
    assert (provenance["recordings"], provenance["configuration"]) == (["droop.h5"], None)
    assert f"<code>{provenance['created_at']}</code>" in report
    assert [item["runs"] for item in answer["held_out"]] == [3, 3]


@pytest.mark.slow
def test_json_on_stdout_and_nothing_else(recording, capsys):
    assert run(["diagnose", str(recording), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "cause"


def test_two_recordings_are_one(recording, tmp_path, capsys):
    other = tmp_path / "more.h5"
    write_recording(other, lab(22, DROOP, groups=("weak", "strong")))
    target = tmp_path / "answer.json"
    assert run(["diagnose", str(recording), str(other), "--json", str(target), "--config", "display-16"]) == 0
    answer = json.loads(target.read_text())
    assert answer["causes"] == ["laser_droop"]
    provenance = answer["provenance"]
    assert (provenance["configuration"], provenance["recordings"]) == ("display-16", ["droop.h5", "more.h5"])
    assert len(provenance["configuration_sha256"]) == 64
    names = answer["runs"]["fitted"] + answer["runs"]["held_out"]
    assert any(name.startswith("more/") for name in names)
    assert capsys.readouterr().out


def test_an_answer_is_never_written_over_a_recording(recording, capsys):
    before = recording.read_bytes()
    assert run(["diagnose", str(recording), "--json", str(recording)]) == 2
    assert "--json" in capsys.readouterr().err
    assert recording.read_bytes() == before


def test_wrong_input_is_one_line_and_nothing_is_written(tmp_path, capsys):
    out = tmp_path / "answer"
    broken = tmp_path / "broken.h5"
    broken.write_bytes(b"no HDF5")
    for path, word in ((broken, "broken.h5"), (tmp_path / "none.h5", "none.h5")):
        assert run(["diagnose", str(path), "--out", str(out), "--json", str(tmp_path / "x.json")]) == 2
        error = capsys.readouterr().err.strip()
        assert word in error
        assert "\n" not in error
    assert not out.exists()
    assert not (tmp_path / "x.json").exists()


def test_samples_all_at_edges_leave_nothing_to_compare(tmp_path, capsys):
    pulses = np.array([[0.0, 0.05, 1.0, 0.0]])
    signal = lab(23, {}, groups=("short",), repeats=1).runs[0].signals["absorber_temperature_K"]
    edges = np.array([0.0, 1e-6, 2e-6, 3e-6, 0.05, 0.05 + 1e-6, 0.05 + 2e-6])
    only = type(signal)(0, edges, np.full(len(edges), 300.0))
    path = tmp_path / "edges.h5"
    write_recording(path, Measurement((Run("one", 293.15, pulses, {"absorber_temperature_K": only}, {}),)))
    assert run(["diagnose", str(path)]) == 2
    assert "finite" in capsys.readouterr().err


def test_the_model_file_is_a_parameter_set_for_a_configuration(recording, tmp_path, capsys):
    out = tmp_path / "answer"
    assert run(["diagnose", str(recording), "--out", str(out)]) == 0
    text = locate_shipped("display-16.toml").read_text()
    config = tmp_path / "mine.toml"
    config.write_text(text.replace('parameters = "surroundings"', f'parameters = "{out / "model.toml"}"'))
    assert str(out) in config.read_text()
    assert run(["config", "check", "--config", str(config)]) == 0
    capsys.readouterr()


def test_the_readme_chain_records_the_noise_of_instruments_and_finds_no_error(tmp_path, capsys):
    frames, out = tmp_path / "frames.json", tmp_path / "recording.h5"
    targets = {str(pixel): 60 + 80 * pixel for pixel in range(4)}
    frames.write_text(json.dumps({"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": targets}]}))
    for noise, said in (([], "1 K, 250 nm, 100 µN rms"), (["--noise", "0"], "none: the recording is exact")):
        out.unlink(missing_ok=True)
        assert run(["simulate", str(frames), "--out", str(out), *noise]) == 0
        assert said in capsys.readouterr().out
        assert run(["diagnose", str(out), "--json", "-"]) == 0
        assert json.loads(capsys.readouterr().out)["verdict"] == "none"
