"""Exit statuses of commands whose stimulus does not fit."""

import json

import pytest

from optodrive.cli.invocation import DOES_NOT_FIT, SUMMARY
from optodrive.cli.main import run
from optodrive.device.config_file import locate_shipped

LATE = {"frames": [{"show_at_s": 0.0, "duration_s": 0.01, "target_um": {"3": 100, "4": 100, "5": 100}}]}
BLANK = {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"3": 0}}]}
WEAK = {"pixel": 3, "start_s": 0.0, "duration_s": 0.1, "pulse_width_s": 0.02, "gap_s": 0.06, "power_w": 0.5}
EASY = {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"3": 50}}]}


@pytest.fixture
def frames(tmp_path):
    def write(content):
        path = tmp_path / "frames.json"
        path.write_text(json.dumps(content))
        return str(path)

    return write


@pytest.mark.parametrize("command", ["plan", "simulate"])
def test_does_not_fit_is_a_status_of_its_own(frames, command, capsys):
    assert run([command, frames(EASY), "--config", "display-16"]) == 0
    assert capsys.readouterr().out.startswith("fits: yes\n")
    for options in ([], ["--json"]):
        assert run([command, frames(LATE), "--config", "display-16", *options]) == DOES_NOT_FIT
        shown = capsys.readouterr()
        assert shown.err == ""
        if options:
            summary = json.loads(shown.out)
            assert summary.get("summary", summary)["feasibility"]["fits"] is False
        else:
            assert shown.out.startswith("fits: no, ")


@pytest.mark.parametrize("command", ["plan", "simulate"])
def test_nothing_raised_is_bad_input_or_does_not_fit(frames, command, capsys, tmp_path):
    assert run([command, frames(BLANK), "--config", "display-16"]) == 2
    assert "a stimulus that raises nothing: every target is 0" in capsys.readouterr().err
    config = tmp_path / "weak.toml"
    shipped = locate_shipped("display-16.toml").read_text()
    config.write_text(shipped.replace("[laser]\n", "[laser]\nthreshold_w = 2.4\n"))
    assert run([command, frames({"trains": [WEAK]}), "--config", str(config)]) == 2
    assert "power_w: got 0.5, expected at least 2.4" in capsys.readouterr().err
    low = {"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"3": 1}}
    assert run([command, frames({"frames": [low]}), "--config", str(config)]) == DOES_NOT_FIT
    said = "fits: no, no pixel is raised: every pulse is weaker than laser.threshold_w\n"
    assert capsys.readouterr().out.startswith(said)


def test_the_files_are_written_all_the_same(frames, tmp_path, capsys):
    out = tmp_path / "plan.csv"
    assert run(["plan", frames(LATE), "--config", "display-16", "--out", str(out)]) == DOES_NOT_FIT
    assert len(out.read_text().splitlines()) == 4
    assert capsys.readouterr().out.endswith(f"written          {out}\n")


@pytest.mark.parametrize(("options", "status"), [(["--fit", "even"], DOES_NOT_FIT), (["--policy", "refuse"], 1)])
def test_a_reduced_variant_does_not_fit_and_a_refusal_fails(frames, options, status, capsys):
    assert run(["plan", frames(LATE), "--config", "display-16", *options]) == status
    shown = capsys.readouterr()
    assert ("fits: no" in shown.out) == (status == DOES_NOT_FIT)
    assert shown.err.count("\n") == (status == 1)


def test_the_help_lists_the_statuses(capsys):
    assert run(["--help"]) == 0
    assert " ".join(capsys.readouterr().out.split()).endswith(SUMMARY)
