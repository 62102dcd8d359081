"""Every optional step of a diagnosis may fail, and the verdict stays."""

from numpy.linalg import LinAlgError

from labs import lab
from optodrive.cli.diagnose import _diagnose_jointly
from optodrive.core.provenance import Provenance
from optodrive.lab import pixel_discovery
from optodrive.lab.diagnosis import diagnose as module
from optodrive.lab.diagnosis import report
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.narrative import build_narrative
from optodrive.lab.recording.csv_folder import write_folder

STEPS = {
    "disturbances of instruments": "find_disturbances",
    "noise beside an effect": "_revise_noise",
    "held-out runs": "compute_held_out_changes",
    "held-out gain": "compute_held_out_gain",
    "intervals beside other forms": "compute_covariance",
    "the next experiment": "propose_for_verdict",
    "traces": "trace_groups",
    "error of heights": "compute_height_error",
}
DROOP = {"laser_droop": {"share": 0.12, "time": 0.05, "spread": 1.0}}


def fail(*arguments, **named):
    """Fail as a singular matrix does."""
    raise LinAlgError("Singular matrix")


def test_no_step_that_is_optional_takes_the_verdict_along(monkeypatch):
    recording = lab(3, DROOP)
    whole = diagnose(recording)
    for function in STEPS.values():
        monkeypatch.setattr(module, function, fail)
    monkeypatch.setattr(report, "list_next_steps", fail)
    found = diagnose(recording)
    assert (found.verdict, found.causes) == (whole.verdict, whole.causes) == ("cause", ("laser_droop",))
    assert not whole.omissions
    assert set(found.omissions) == set(STEPS)
    assert all(reason == "LinAlgError: Singular matrix" for reason in found.omissions.values())
    lines = build_narrative(found)
    assert all(f"Left out, for it failed: {step} (LinAlgError: Singular matrix)." in lines for step in STEPS)
    assert "laser" in report.build_report(found, "recording.h5")


def test_neither_does_the_search_for_an_unknown_term(monkeypatch, tmp_path):
    monkeypatch.setattr(pixel_discovery, "discover_in_pixel", fail)
    write_folder(tmp_path, lab(3, DROOP).runs, "")
    output = _diagnose_jointly([tmp_path], None, "droop", 0, None, None, Provenance.capture([], [], None), True, ())
    assert (output.document["verdict"], output.document["discovery"]) == ("cause", None)
    step = "the search for a term that no catalogue holds"
    assert output.document["omissions"] == {step: "LinAlgError: Singular matrix"}
    assert f"Left out, for it failed: {step} (LinAlgError: Singular matrix)." in output.narrative
