"""`optodrive terms`, the lines that it prints, and the terms of a ground truth."""

import json

import pytest

from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.physics.parameters import load_parameters
from optodrive.physics.term_reference import build_example
from optodrive.physics.terms import discover_terms

HEAD = """format = "optodrive-parameters"
version = 1
name = "truth"
base = "surroundings"
claims = "for tests"
"""
CREEP = '[terms.membrane_creep]\nshare = {value = 0.3, unit = "1", source = "a"}\n'
TIME = 'time = {value = 0.02, unit = "s", source = "a"}\n'
FRAMES = {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"5": 200}}]}


@pytest.fixture
def frames(tmp_path):
    path = tmp_path / "frames.json"
    path.write_text(json.dumps(FRAMES))
    return str(path)


def _simulate(capsys, frames, path):
    assert run(["simulate", frames, "--pixels", "5", "--truth", str(path), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("key", discover_terms())
def test_the_file_that_states_a_term_loads_as_it_is_printed(key, tmp_path, capsys):
    path, term = tmp_path / "set.toml", discover_terms()[key]
    assert run(["terms", key]) == 0
    path.write_text(capsys.readouterr().out.split("\nmodel.toml:\n\n")[1])
    values = load_parameters(path).term_values(key)
    assert list(values) == [item.name for item in term.parameters]
    omitted = [item for item in term.parameters if f"\n{item.name} = " not in "\n".join(build_example(term))]
    assert [values[item.name] for item in omitted] == [item.if_omitted for item in omitted]


def test_a_printed_file_is_a_truth(frames, tmp_path, capsys):
    assert run(["terms", "membrane_creep"]) == 0
    path = tmp_path / "set.toml"
    path.write_text(capsys.readouterr().out.split("\nmodel.toml:\n\n")[1])
    assert _simulate(capsys, frames, path)["truth"]["terms"] == ["membrane_creep"]


def test_an_empty_term_and_a_required_parameter_are_refused(tmp_path):
    path = tmp_path / "set.toml"
    for text, place in (("[terms.clock_offset]\n", "clock_offset"), (CREEP, "membrane_creep.time")):
        path.write_text(HEAD + text)
        with pytest.raises(InputError, match=place):
            load_parameters(path)


def test_the_command_lists_all_shows_one_and_refuses_another(capsys):
    assert run(["terms"]) == 0
    listed = capsys.readouterr().out
    assert all(f"{key} " in listed for key in discover_terms())
    assert run(["terms", "membrane_creep"]) == 0
    shown = capsys.readouterr().out
    assert "spread            1 to 30, 1.5 if omitted" in shown
    assert "[terms.membrane_creep]" in shown
    assert run(["terms", "--json"]) == 0
    assert [item["key"] for item in json.loads(capsys.readouterr().out)["terms"]] == sorted(discover_terms())
    assert run(["terms", "membrane_crep"]) == 2
    assert "nearest is 'membrane_creep'" in capsys.readouterr().err


def test_a_truth_has_every_term_that_its_file_states_and_tells_the_rest(frames, tmp_path, capsys):
    silent, planned = tmp_path / "silent.toml", tmp_path / "planned.toml"
    silent.write_text(HEAD + CREEP + TIME)
    planned.write_text(HEAD + 'planner_terms = ["membrane_creep"]\n' + CREEP + TIME)
    answers = [_simulate(capsys, frames, path) for path in (silent, planned)]
    assert answers[0]["truth"]["terms"] == answers[1]["truth"]["terms"] == ["membrane_creep"]
    assert "wall_heating" in answers[0]["truth"]["ignored_terms"]
    heights_um = [item["pixels"][0]["measured_max_um"] for item in answers]
    assert heights_um[0] == heights_um[1] > 1.05 * 200
    assert run(["simulate", frames, "--pixels", "5", "--truth", str(silent)]) == 0
    output = capsys.readouterr().out
    assert "truth            membrane_creep\n" in output
    assert "not simulated: wall_heating" in output


def test_a_truth_refuses_a_term_that_only_the_limiter_knows(frames, tmp_path, capsys):
    path = tmp_path / "truth.toml"
    path.write_text(HEAD + "\n".join(build_example(discover_terms()["touch_surface"])))
    assert run(["simulate", frames, "--truth", str(path)]) == 2
    assert "terms.touch_surface" in capsys.readouterr().err


def test_the_beginning_of_a_name_is_nearest_to_this_name(capsys):
    assert run(["terms", "membrane"]) == 2
    assert "nearest is 'membrane_creep'" in capsys.readouterr().err
