"""`optodrive calibrate servo`, and plans that use its output."""

import json
import tomllib
from contextlib import redirect_stdout

import numpy as np
import pytest

from hidden_servo import SIZES_RAD, HiddenServo, recording
from optodrive.cli.main import run
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.device.field_loader import build_settling_table
from optodrive.device.gate_timing import build_servo, settling_s
from optodrive.lab.recording import write_recording
from optodrive.lab.servo_identification.gate import move_sizes_rad

SERVOS = HiddenServo(1100.0, 0.62, 5e-5, 80.0), HiddenServo(1250.0, 0.55, 3e-5, 95.0)
CAP = "galvo_acceleration_rms_max_rad_per_s2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a recording, the mirrors.toml identified from it, and the report."""
    at = tmp_path_factory.mktemp("mirrors")
    write_recording(at / "r.h5", recording(SERVOS, np.random.default_rng(20)))
    with (at / "report.json").open("w") as report, redirect_stdout(report):
        assert run(["calibrate", "servo", f"{at}/r.h5", "--out", f"{at}/mirrors.toml", "--json"]) == 0
    return at


def write_config(folder, name="mirrors.toml"):
    config_path = folder / "own.toml"
    text = locate_shipped("display-437.toml").read_text()
    config_path.write_text(text.replace("[scanner]\n", f'[scanner]\nmirrors = "{name}"\n'))
    return config_path


def test_the_file_says_both_axes_and_one_servo_for_them(folder):
    table = tomllib.loads((folder / "mirrors.toml").read_text())
    assert (table["format"], table["version"]) == ("optodrive-mirrors", 1)
    for axis, servo in zip("xy", SERVOS, strict=True):
        assert table["axes"][axis]["bandwidth_hz"] == pytest.approx(servo.hz, rel=0.03)
        assert table["axes"][axis]["delay_s"] == pytest.approx(servo.delay_s, abs=1e-5)
    assert table["scanner"]["slew_rad_per_s"] == pytest.approx(80.0, rel=0.02)
    assert table["scanner"]["delay_s"] == pytest.approx(5e-5, abs=2e-6)


def test_settle_times_are_held_against_the_configured_ones_step_by_step(folder):
    report = json.loads((folder / "report.json").read_text())
    config = load_config()
    for axis, (name, servo) in enumerate(zip("xy", SERVOS, strict=True)):
        rows = report["axes"][name]["settling"]
        assert [row["step_rad"] for row in rows] == pytest.approx(SIZES_RAD)
        for row, size_rad in zip(rows, SIZES_RAD, strict=True):
            for key, tolerance_rad in (("gate", config.tolerance_rad[axis]), ("share", 0.02 * size_rad)):
                assert row[key]["measured_s"] == pytest.approx(servo.settled_s(size_rad, tolerance_rad), rel=0.05)
                low_s, high_s = row[key]["interval_s"]
                assert low_s <= row[key]["measured_s"] <= high_s
                configured_s = settling_s(build_servo(config.scanner), size_rad, tolerance_rad)
                assert row[key]["configured_s"] == pytest.approx(configured_s)
    assert any("one servo model covers both" in remark for remark in report["remarks"])


def test_a_stage_s_servos_are_held_against_its_own_scanner(folder, capsys):
    config = folder / "stages.toml"
    stages = [
        f'\n[[stages]]\nname = "{name}"\nscanner = {{ bandwidth_hz = {hz} }}\n'
        for name, hz in (("left", 900.0), ("right", 1600.0))
    ]
    config.write_text(locate_shipped("display-437.toml").read_text() + "".join(stages))
    write_recording(folder / "short.h5", recording(SERVOS, np.random.default_rng(21), sizes_rad=(0.03,), count=8))
    arguments = ["calibrate", "servo", f"{folder}/short.h5", "--json", "--config", str(config)]
    assert run(arguments) == 2
    assert capsys.readouterr().err == "optodrive: --stage: missing, expected one of left, right\n"
    settling_s = []
    for name in ("left", "right"):
        assert run([*arguments, "--stage", name]) == 0
        settling_s.append(json.loads(capsys.readouterr().out)["axes"]["x"]["settling"][0]["gate"]["configured_s"])
    assert settling_s[0] > settling_s[1]


def test_the_one_servo_settles_no_sooner_than_either_mirror(folder):
    config = load_config(write_config(folder))
    for axis, hidden in enumerate(SERVOS):
        for move_rad in move_sizes_rad(config, axis):
            tolerance_rad = config.tolerance_rad[axis]
            common_s = settling_s(build_servo(config.scanner), move_rad, tolerance_rad)
            assert common_s > 0.995 * hidden.settled_s(move_rad, tolerance_rad)


def test_a_configuration_with_mirrors_moves_by_them_and_keeps_the_galvo_cap_true(folder):
    measured, stated = load_config(write_config(folder)), load_config("display-437")
    table = tomllib.loads((folder / "mirrors.toml").read_text())
    assert measured.scanner.mirrors == str(folder / "mirrors.toml")
    assert measured.scanner.bandwidth_hz == table["scanner"]["bandwidth_hz"]
    assert 0.2 < table["galvo"]["share"] <= 1.0
    assert getattr(measured.limits, CAP) == pytest.approx(table["galvo"]["share"] * getattr(stated.limits, CAP))
    moves, before = build_settling_table(measured), build_settling_table(stated)
    assert moves.settling_us(moves.pitch_rad, 0.0) > before.settling_us(before.pitch_rad, 0.0)


def test_a_plan_takes_longer_by_the_option_as_by_the_configuration(folder, capsys):
    frames = folder / "frames.json"
    frames.write_text('{"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50, "300": 60}}]}')

    def settling_s(*more):
        assert run(["plan", str(frames), "--json", *more]) == 0
        return json.loads(capsys.readouterr().out)["settling_s"]

    by_option = settling_s("--mirrors", f"{folder}/mirrors.toml")
    assert by_option > settling_s()
    assert by_option == settling_s("--config", str(write_config(folder)))
    # With --mirrors and a configuration that names the same file, the cap is lowered once.
    assert by_option == settling_s("--config", str(write_config(folder)), "--mirrors", f"{folder}/mirrors.toml")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"optodrive-mirrors"', '"optodrive-field"', "expected 'optodrive-mirrors'"),
        ("version = 1", "version = 2", "expected 1, the one this release reads"),
        ("[scanner]", "[scaner]", "nearest is 'scanner'"),
        ("share = ", "share = 1", "less than or equal to 1"),
    ],
)
def test_a_wrong_file_of_mirrors_is_one_line(folder, capsys, old, new, words):
    text = (folder / "mirrors.toml").read_text()
    assert old in text
    (folder / "wrong.toml").write_text(text.replace(old, new, 1))
    assert run(["config", "check", "--config", str(write_config(folder, "wrong.toml"))]) == 2
    errors = capsys.readouterr().err
    assert words in errors
    assert "wrong.toml" in errors
