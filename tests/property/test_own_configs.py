"""A configuration of one's own that `config check` accepts is accepted by all other commands at the first try.

The chain of README: check, plan, simulate, diagnose. A simulation of the planned model has no error to be found.
"""

import json

import pytest
from hypothesis import HealthCheck, Phase, given, reject, settings
from hypothesis import strategies as st

from exclusive_rig import ExclusiveRig
from optodrive.cli.invocation import DOES_NOT_FIT
from optodrive.cli.main import run
from optodrive.device.config_file import load_config
from optodrive.lab.commissioning.homing import Homing
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.simulator.true_geometry import GroundTruthGeometry
from optodrive.planning.display_model import DisplayModel
from own_configs import frames, tables, write_config

SEEDS = st.integers(0, 1000)
SETTINGS = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.filter_too_much],
    phases=[Phase.reuse, Phase.generate],  # shrinking takes minutes
)


def call(capsys, *arguments):
    """Run a command with --json. Return its exit status, its document and its line of error."""
    capsys.readouterr()
    status = run([str(item) for item in arguments])
    written = capsys.readouterr()
    return status, json.loads(written.out) if written.out else None, written.err


def check(capsys, path):
    """Return the display of a configuration. Return None after one line that refuses it."""
    status, _, error = call(capsys, "config", "check", "--config", path, "--json")
    if status == 0:
        return DisplayModel.from_config(load_config(path))
    assert status == 2, error
    assert error.startswith("optodrive: "), error
    assert error.count("\n") == 1, error
    return None


def record(capsys, folder, path, shown, seed):
    """Plan and simulate. Return the recording and its number of pulses."""
    (folder / "frames.json").write_text(json.dumps(shown))
    out = folder / "recording.h5"
    out.unlink(missing_ok=True)
    status, planned, error = call(capsys, "plan", folder / "frames.json", "--config", path, "--json")
    assert status in (0, DOES_NOT_FIT), error
    options = ("--out", out, "--repeats", 3, "--seed", seed, "--json")
    status, simulated, error = call(capsys, "simulate", folder / "frames.json", "--config", path, *options)
    assert status in (0, DOES_NOT_FIT), error
    assert simulated["complete"]
    assert simulated["summary"]["pulses"] == planned["pulses"]
    return out, simulated["executed"]


def check_chain(tmp_path, capsys, data, table, seed):
    """Fail where a command refuses a configuration that `config check` accepts."""
    path = write_config(tmp_path / "own.toml", table)
    if (display := check(capsys, path)) is None:
        reject()
    record(capsys, tmp_path, path, data.draw(frames(display)), seed)
    for stage in display.config.list_stage_configs():
        limits = build_board_requirements(stage).limits
        assert len(limits.encode_body()) == limits.LAYOUT.size
        GroundTruthGeometry.sample(437, stage)
        rig = ExclusiveRig(DisplayModel.from_config(stage), lambda x_code, y_code, at_us: None)
        Homing(rig.held, None, 0.0).run(lambda result: None)
        assert rig.of("pulse") == []


def check_diagnosis(tmp_path, capsys, data, table, seed):
    """Fail where the diagnosis of a simulation of the planned model names an error."""
    path = write_config(tmp_path / "own.toml", table)
    if (display := check(capsys, path)) is None:
        reject()
    recording, executed = record(capsys, tmp_path, path, data.draw(frames(display)), seed)
    status, answer, error = call(capsys, "diagnose", recording, "--config", path, "--json", "-")
    assert status == 0 or not executed, error
    assert answer is None or (answer["verdict"] in ("none", "undecided") and answer["causes"] == [])


@given(st.data(), tables(st.integers(1, 2)), SEEDS)
@settings(SETTINGS, max_examples=6)
def test_what_is_valid_is_planned_and_simulated(tmp_path, capsys, data, table, seed):
    check_chain(tmp_path, capsys, data, table, seed)


@given(st.data(), tables(), SEEDS)
@settings(SETTINGS, max_examples=2)
def test_a_diagnosis_of_a_simulation_of_the_planned_model_names_nothing(tmp_path, capsys, data, table, seed):
    check_diagnosis(tmp_path, capsys, data, table, seed)


@pytest.mark.slow
@given(st.data(), tables(st.integers(1, 2)), SEEDS)
@settings(SETTINGS, max_examples=150)
def test_more_of_what_is_valid_is_planned_and_simulated(tmp_path, capsys, data, table, seed):
    check_chain(tmp_path, capsys, data, table, seed)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@given(st.data(), tables(), SEEDS)
@settings(SETTINGS, max_examples=40)
def test_more_diagnoses_of_simulations_name_nothing(tmp_path, capsys, data, table, seed):
    check_diagnosis(tmp_path, capsys, data, table, seed)
