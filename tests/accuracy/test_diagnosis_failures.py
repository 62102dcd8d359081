"""A hypothesis that cannot be computed is named, and nothing is concluded from its silence."""

from dataclasses import replace

import numpy as np
import pytest

from labs import lab
from optodrive.core.errors import DivergedError, OptodriveError
from optodrive.core.types.measurements import Measurement
from optodrive.lab.diagnosis import detection
from optodrive.lab.diagnosis.dataset import build_dataset
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer, PixelAnswer
from optodrive.lab.diagnosis.display_report import build_display_answer, build_headline
from optodrive.lab.diagnosis.narrative import build_answer, build_narrative
from optodrive.lab.diagnosis.nominal_fit import fit_nominal
from optodrive.lab.diagnosis.report import build_report
from optodrive.physics.hypothesis import RecordingScope
from optodrive.physics.terms import discover_terms

FAST_PER_S = 5000.0
"""Rate of a state that follows within 0.2 ms, faster than the integrator's steps permit."""
DROOP = {"laser_droop": {"share": 0.08, "time": 0.05, "spread": 1.0}}
SMALL = {"groups": ("middle", "strong", "train"), "repeats": 2}


@pytest.fixture
def fast_leak(monkeypatch):
    """Let a diagnosis search for a leak of 0.2 ms."""
    leak = discover_terms()["gas_leak"]
    (rate,) = leak.parameters
    monkeypatch.setattr(leak, "parameters", (replace(rate, high=2 * FAST_PER_S, starts=(2.0, FAST_PER_S)),), False)


@pytest.mark.filterwarnings("error")
def test_no_error_is_not_concluded_from_a_cause_that_diverges(fast_leak):
    found = diagnose(lab(11, {}, **SMALL))
    assert (found.verdict, found.causes, found.terms) == ("incomplete", (), {})
    assert list(found.failures) == ["gas_leak"]
    assert found.failures["gas_leak"].startswith(
        "term gas_leak: got a time constant of 200 µs, expected 2.2 ms or more"
    )
    lines = build_narrative(found)
    assert lines[0] == ("The search is incomplete, for gas_leak could not be computed; nothing else shows an error.")
    assert not any("No error" in line for line in lines)
    assert f"- gas_leak: {found.failures['gas_leak']}" in lines
    answer = build_answer(found)
    assert (answer["verdict"], answer["failures"]) == ("incomplete", found.failures)
    report = build_report(found, "leak.h5")
    assert "The search is incomplete" in report
    assert "No error" not in report
    display = DisplayAnswer((PixelAnswer(0, found), PixelAnswer(1, replace(found, verdict="none"))), None, 1.0)
    assert build_headline(display) == (
        "Of 2 pixels, each diagnosed separately, none of the other 1 shows an error of the nominal model; for 1, the "
        "search is incomplete."
    )
    assert build_display_answer(display)["summary"]["verdicts"]["incomplete"] == 1


def test_a_named_cause_is_not_certain_beside_one_that_diverges(fast_leak):
    found = diagnose(lab(12, DROOP, **SMALL))
    assert (found.verdict, found.causes) == ("cause", ("laser_droop",))
    assert build_narrative(found)[0] == (
        "The nominal model is wrong, perhaps because the laser's power falls while it is on; gas_leak could not be "
        "computed and may explain it."
    )


def test_a_test_without_a_number_ends_the_diagnosis(monkeypatch):
    """A comparison with a level would take it for no finding."""

    def project_nothing(gram, removed, kept):
        return np.full((len(kept), len(kept)), np.nan)

    monkeypatch.setattr(detection, "project_out", project_nothing)
    with pytest.raises(OptodriveError, match="the test of the residuals gave no number"):
        diagnose(lab(11, {}, groups=("middle", "strong"), repeats=2))


@pytest.mark.parametrize(("effect", "ratio"), [(1e4, 1e8), (np.inf, np.inf), (np.nan, np.nan), (-1.0, 0.0)])
def test_an_effect_of_any_size_has_its_ratio_and_one_without_a_number_none(effect, ratio):
    """A mirror's lag has χ² of 10⁸ against noise that counts as known."""
    leak = discover_terms()["gas_leak"]
    (hypothesis,) = leak.build_hypotheses(RecordingScope(("displacement",), (0,), frozenset({0}), False, 1))
    projected = np.array([[1.0, effect], [effect, 1.0]])
    with np.errstate(all="ignore"):
        (score,) = detection.compute_scores(((hypothesis, hypothesis.starts[0]),), projected, np.ones(1), np.ones(1))
    assert np.array_equal(score.ratio, ratio, equal_nan=True)


def test_a_nominal_model_that_diverges_is_refused():
    runs = lab(11, {}, groups=("middle", "strong"), repeats=2).runs
    hot = [replace(run, pulses=run.pulses * [1.0, 1.0, 1e7, 1.0]) for run in runs]
    with pytest.raises(DivergedError, match=r"the pixel: got .* as state 'gas'"):
        fit_nominal(build_dataset(Measurement(tuple(hot))))
