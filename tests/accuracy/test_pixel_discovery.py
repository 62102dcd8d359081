"""A term that no catalogue holds is found in a recording of a pixel, and nothing where nothing is hidden."""

import json
from dataclasses import replace

import numpy as np
import pytest

from labs import lab
from optodrive.cli.main import run
from optodrive.core.types.measurements import Measurement
from optodrive.lab.recording import write_recording

SLACK_M = 4e-5
pytestmark = pytest.mark.timeout(600)


def lab_with_slack(seed):
    """Return the recording of a membrane whose first part of the displacement is missing."""
    runs = []
    for noisy, exact in zip(lab(seed, {}).runs, lab(seed, {}, noise=0.0).runs, strict=True):
        signal = noisy.signals["displacement_m"]
        missing_m = np.minimum(exact.signals["displacement_m"].value, SLACK_M)
        runs.append(
            replace(noisy, signals=noisy.signals | {"displacement_m": replace(signal, value=signal.value - missing_m)})
        )
    return Measurement(tuple(runs))


def test_nothing_is_found_where_nothing_is_hidden(tmp_path, capsys):
    path = tmp_path / "nothing.h5"
    write_recording(path, lab(31, {}))
    assert run(["diagnose", str(path), "--discover", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)["discovery"]
    assert found["findings"] == []
    assert found["judged_by"] == "held-out experiments: middle"
    assert found["error_before"] == found["error_after"] == pytest.approx(1.0, abs=0.2)


def test_an_unexplained_recording_is_searched_for_the_term_that_nobody_wrote_down(tmp_path, capsys):
    path, out = tmp_path / "slack.h5", tmp_path / "answer"
    write_recording(path, lab_with_slack(32))
    assert run(["diagnose", str(path), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    answer, report = json.loads((out / "diagnosis.json").read_text()), (out / "report.html").read_text()
    assert answer["verdict"] == "unexplained"
    (finding,) = answer["discovery"]["findings"]
    assert (finding["node"], finding["where"], finding["unit"]) == ("membrane", "displacement", "m")
    assert finding["depends_on"] == [{"name": "gas", "unit": "K"}]
    assert finding["kind"] == "saturation"
    assert finding["gain"] > 0.8
    assert finding["probability"] > 0.99
    curve = {name: np.array(values) for name, values in finding["curve"].items()}
    warm = curve["x"] > 0.2 * curve["x"].max()
    assert curve["y"][warm] == pytest.approx(-SLACK_M, rel=0.1)
    assert (curve["low"] <= curve["y"]).all()
    assert (curve["y"] <= curve["high"]).all()
    assert f"the measured displacement, m: {finding['formula']}" in text
    assert "the membrane lacks one that depends on rise of the gas (saturation)" in text
    assert "displacement against rise of the gas" in report
    assert answer["discovery"]["error_after"] < 0.5 * answer["discovery"]["error_before"]
