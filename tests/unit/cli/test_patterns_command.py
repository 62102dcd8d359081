"""`optodrive patterns`: a pattern as a file, without a daemon."""

import json

import pytest

from optodrive.cli.main import run
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.sequence_file import load_sequence, sequence_to_json


def test_a_written_pattern_is_the_pattern_of_that_display(tmp_path, capsys):
    out, config = tmp_path / "hello.json", load_config("display-1511")
    arguments = ["patterns", "text", "hello", "height_um=150", "--out", str(out), "--config", "display-1511"]
    assert run(arguments) == 0
    capsys.readouterr()
    expected = build_pattern("text", {"text": "hello", "height_um": 150}, config)
    assert sequence_to_json(load_sequence(out, config)) == sequence_to_json(expected)
    assert run(["plan", str(out), "--config", "display-1511", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pulses"] > 0


def test_the_policy_of_an_experiment_is_told(tmp_path, capsys):
    assert run(["patterns", "experiment-4", "level=9", "--out", str(tmp_path / "e.json")]) == 0
    assert "its policy is refuse: --policy refuse" in capsys.readouterr().out
    assert run(["patterns", "experiment-4", "--out", str(tmp_path / "f.json"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["policy"] == "refuse"


def test_one_pattern_is_described(capsys):
    assert run(["patterns", "scope"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("scope: ")
    assert "    power_mw=25.0 (0.1 to 50 mW)  power of the pulses" in lines
    assert len([line for line in lines if not line.startswith("    ")]) == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--out", "f.json"], "PATTERN: missing"),
        (["text", "hello"], "--out: missing, expected --out FRAMES.json for hello"),
        (["texd", "--out", "f.json"], "nearest is 'text'"),
        (["text", "hello", "--out", "f.csv"], "a name that ends in .json"),
        (["text", "hello", "size=3", "--out", "f.json"], "pattern text: got 'size'"),
    ],
)
def test_refusals(tmp_path, monkeypatch, capsys, arguments, says):
    monkeypatch.chdir(tmp_path)
    assert run(["patterns", *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [["push"], ["plan"], ["play", "image"], ["patterns", "image", "--out", "f.json"]])
def test_a_file_without_end_is_refused_before_a_daemon_is_asked(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    assert run([*arguments, "/dev/zero"]) == 2
    assert capsys.readouterr().err == "optodrive: /dev/zero: got a larger file, expected at most 64000000 bytes\n"
