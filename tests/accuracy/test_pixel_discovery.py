"""A term that no catalogue holds is found in a recording of a pixel, and nothing where nothing is hidden."""

import json

import numpy as np
import pytest

from labs import AMBIENT_K, PIXEL, SLACK_M, lab, lab_with_slack
from optodrive.cli.main import run
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.lab.diagnosis.narrative import build_model_toml
from optodrive.lab.recording import write_recording
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence

WIDTH_M = 0.4e-3
TRUE_BASE = {
    "R": PIXEL.r_k_per_w,
    "C": PIXEL.c_j_per_k,
    "tau_g": PIXEL.tau_g_s,
    "kappa": PIXEL.kappa_m_per_k,
    "phi": PIXEL.phi_n_per_k,
}
pytestmark = pytest.mark.timeout(600)


def test_nothing_is_found_where_nothing_is_hidden(tmp_path, capsys):
    path = tmp_path / "nothing.h5"
    write_recording(path, lab(31, {}))
    assert run(["diagnose", str(path), "--discover", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)["discovery"]
    assert found["findings"] == []
    assert found["verdict"] in ("none", "undecided")
    assert found["judged_by"] == "held-out experiments: short, train"
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
    assert finding["probability_missing"] > 0.99
    assert finding["probability_place"] > 0.9
    assert [each["split"] for each in finding["gains"]] == [
        "short, train",
        "strong (the largest)",
        "short (the smallest)",
    ]
    # Its rival moves the gas in place of the reading, to the same effect but for a time of 3 ms. At its own place an
    # end stop is the same function beside another ratio of displacement and gas.
    rivals = {(each["where"], each["kind"]) for each in finding["rivals"]}
    assert finding["verdict"] == "ambiguous"
    assert rivals - {("displacement", "end stop")} == {("dgas/dt", "saturation")}
    assert f"next record: {finding['next_record']}" in text
    curve = {name: np.array(values) for name, values in finding["curve"].items()}
    warm = curve["x"] > 0.2 * curve["x"].max()
    assert curve["y"][warm] == pytest.approx(-SLACK_M, rel=0.1)
    assert (curve["low"] <= curve["y"]).all()
    assert (curve["y"] <= curve["high"]).all()
    assert f"the measured displacement, m: {finding['formula']}" in text
    assert "the membrane lacks one that depends on rise of the gas (perhaps saturation)" in text
    assert "displacement against rise of the gas" in report
    assert answer["discovery"]["error_after"] < 0.5 * answer["discovery"]["error_before"]
    assert f"Heights are planned with it: optodrive plan frames.json --model {out / 'model.toml'}" in text
    nominal = build_model_toml(TRUE_BASE, {}, "none", "truth", WIDTH_M)
    (tmp_path / "nominal.toml").write_text(nominal)
    before, after = plan_on_slack_membrane(tmp_path / "nominal.toml"), plan_on_slack_membrane(out / "model.toml")
    assert before > 0.1
    assert after < 0.2 * before


def plan_on_slack_membrane(model):
    """Plan heights with a model, and return the rms of their relative errors on the slack membrane."""
    config = load_config("display-16")
    section = config.pixel_model.model_copy(update={"parameters": str(model)})
    width = config.display.model_copy(update={"bridge_width_m": WIDTH_M})
    display = DisplayModel.from_config(config.model_copy(update={"display": width, "pixel_model": section}))
    heights_m = np.linspace(6e-5, 2e-4, len(display.layout))
    frames = FrameSequence((TactileFrame("ladder", 0.0, 0.5, heights_m),), ())
    plan = plan_sequence(display, frames, *display.build_cold_state()).plan
    assert not plan.reason.any()
    errors = []
    for row in range(len(plan)):
        t_s = np.arange(0.0, plan.width_s[row] + 0.05, 1e-4)
        pulse = np.array([[0.0, plan.width_s[row], plan.power_w[row], 0.0]])
        scene = PixelExperiment(pulse, 0, AMBIENT_K, (t_s[:0], t_s, t_s[:0]))
        displacement_m = simulate_signals(scene, PIXEL, ActiveTerms.from_values({}))[1]
        height_m = float((displacement_m - np.minimum(displacement_m, SLACK_M)).max())
        errors.append(height_m / plan.target_m[row] - 1.0)
    return float(np.sqrt(np.mean(np.square(errors))))
