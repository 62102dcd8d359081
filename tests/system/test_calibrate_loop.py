"""`optodrive calibrate board` on a board process and its sensor, with hidden geometries."""

import json
import re
import signal

import numpy as np
import pytest

from optodrive.device.calibrated_field import load_field
from optodrive.device.config_file import load_config
from optodrive.lab.calibration.spots import read_spots
from optodrive.lab.commissioning.measurement_loop import build_code_grid
from optodrive.link.simulator.guards import DEFAULT_LIMITS
from optodrive.link.simulator.true_geometry import GroundTruthGeometry
from rig import wait_for
from signalled_processes import assert_dark_within_lease
from test_home import assert_dark, step_of

CONFIG = load_config()
ENDLESS = ("--target-rms-um", "0.1", "--spots-max", "100")


def since_light(kind, name):
    return step_of(1.0, kind, name) + 'from = "light"\n'


def missed_m(field, geometry):
    """Return the errors of a field against the ground truth over the display."""
    codes = build_code_grid(CONFIG, 0.0, 41)
    truth = GroundTruthGeometry.sample(geometry, CONFIG)
    return np.hypot(*(np.array(field.position_m(*codes.T)) - np.array(truth.position_m(*codes.T))))


def rms_um(lengths_m):
    return 1e6 * float(np.sqrt(np.mean(lengths_m**2)))


def session_spots(out):
    path = out.with_name(out.name + ".session.json")
    return json.loads(path.read_text())["spots"] if path.exists() else []


@pytest.mark.parametrize(
    ("geometry", "more"),
    [
        pytest.param(0, (), marks=pytest.mark.slow),
        (1, ("--outlier-share", "0.1")),
        pytest.param(2, ("--no-readback",), marks=pytest.mark.slow),
    ],
)
def test_ten_micrometres_with_25_spots(make_board, start, tmp_path, geometry, more):
    board, out = make_board(sensor=("--geometry", str(geometry), *more)), tmp_path / "field.toml"
    status, output, errors = start(board, "calibrate", "board", "--yes", "--out", out, "--json").ended()
    assert status == 0, errors
    answer = json.loads(output)
    assert answer["target_reached"] is True
    assert answer["spots"] <= 25
    field = load_field(out)
    assert rms_um(missed_m(field, geometry)) <= 10.0
    spots = read_spots(tmp_path / "field.spots.csv")
    assert len(spots) == answer["spots"]
    nominal_m = (np.array([spots.x_code, spots.y_code]) - 32768) * CONFIG.scanner.rad_per_code * 2 * 0.220
    assert (
        np.hypot(*(nominal_m - [spots.x_m, spots.y_m])).max() > 0.3e-3
    )  # without the field the beam misses the pixels
    assert not session_spots(out)
    pulses = assert_dark(board).of("pulse")
    assert len(pulses) <= 3 * 25 + 3
    assert max(pulse["duty"] for pulse in pulses) / 65535 * DEFAULT_LIMITS.full_power_uw * 1e-6 <= 5e-3
    assert max(pulse["off_us"] - pulse["on_us"] for pulse in pulses) == 20_000


@pytest.mark.slow
def test_ctrl_c_and_resume(make_board, start, tmp_path):
    board, out = make_board(sensor=("--geometry", "3")), tmp_path / "field.toml"
    command = start(board, "calibrate", "board", "--yes", "--out", out)
    wait_for(lambda: len(session_spots(out)) >= 6, "six spots")
    command.process.send_signal(signal.SIGINT)
    status, _, errors = command.ended()
    assert status == 130
    assert errors.endswith("optodrive: interrupted\n")
    assert not out.exists()
    kept = session_spots(out)
    pulses_before = len(assert_dark(board).of("pulse"))

    status, output, errors = start(board, "calibrate", "board", "--yes", "--out", out, "--json").ended()
    assert status == 0, errors
    assert f"resuming with {len(kept)} spots" in errors
    answer = json.loads(output)
    assert read_spots(tmp_path / "field.spots.csv").to_table()[: len(kept)] == pytest.approx(np.array(kept))
    assert len(assert_dark(board).of("pulse")) - pulses_before <= 3 * (answer["spots"] - len(kept)) + 3
    assert rms_um(missed_m(load_field(out), 3)) <= 10.0


@pytest.mark.slow
def test_a_moved_display_is_detected(make_board, start, tmp_path):
    board, out = make_board(sensor=("--geometry", "3")), tmp_path / "field.toml"
    command = start(board, "calibrate", "board", "--yes", "--out", out, *ENDLESS)
    wait_for(lambda: len(session_spots(out)) >= 3, "three spots")
    command.process.send_signal(signal.SIGINT)
    assert command.ended()[0] == 130
    path = out.with_name(out.name + ".session.json")
    kept = json.loads(path.read_text())
    kept["spots"] = [[x_code, y_code, x_m + 200e-6, y_m] for x_code, y_code, x_m, y_m in kept["spots"]]
    path.write_text(json.dumps(kept))
    pulses_before = len(assert_dark(board).of("pulse"))

    status, _, errors = start(board, "calibrate", "board", "--yes", "--out", out).ended()
    assert status == 1
    found = re.search(r"moved since: .* (\d+) µm off and (\d+) µm off, expected at most (\d+) µm; delete", errors)
    assert found, errors
    assert all(100 < int(each) < 300 for each in found.groups()[:2])
    assert json.loads(path.read_text()) == kept
    assert len(assert_dark(board).of("pulse")) - pulses_before <= 2 * 3 + 2


def test_kill_9(make_board, start, tmp_path):
    board, out = make_board(sensor=()), tmp_path / "field.toml"
    command = start(board, "calibrate", "board", "--yes", "--out", out, *ENDLESS)
    wait_for(lambda: len(session_spots(out)) >= 3, "three spots")
    command.process.kill()
    command.process.wait()
    assert_dark(board, ("DISARMED", "FAULT"))
    assert_dark_within_lease(board)
    assert len(session_spots(out)) >= 3


@pytest.mark.parametrize(
    ("script", "says"),
    [
        pytest.param(
            step_of(0.0, "do", "stick_y"),
            r"calibrate: sensor at .*: y_m: got .* this mirror does not move",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            step_of(0.0, "do", "blind_sensor"),
            r"calibrate: 3 consecutive positions without a spot: sensor at .* sees no spot",
            marks=pytest.mark.slow,
        ),
        (since_light("set", "interlock"), r"the board went to FAULT INTERLOCK: .*close the enclosure"),
        pytest.param(
            since_light("do", "unplug_sensor"), r"sensor: link to .* lost: .*is missing", marks=pytest.mark.slow
        ),
        pytest.param(since_light("do", "close"), r"link to .* lost", marks=pytest.mark.slow),
    ],
)
def test_the_cause_of_an_end_is_named(make_board, start, tmp_path, script, says):
    board, out = make_board(sensor=(), script=script), tmp_path / "field.toml"
    status, output, errors = start(board, "calibrate", "board", "--yes", "--out", out, "--json", *ENDLESS).ended()
    assert status == 1
    last = errors.splitlines()[-1]
    assert re.match(f"optodrive: {says}", last), errors
    assert not output
    assert not out.exists()
    assert_dark(board, ("DISARMED", "FAULT"))


@pytest.mark.slow
def test_spots_located_by_a_person(make_board, start, tmp_path):
    """The person locates the spot to 20 µm and enters its distance from the mark."""
    board, out = make_board(sensor=("--geometry", "4")), tmp_path / "field.toml"
    command = start(board, "calibrate", "board", "--yes", "--manual", "--spots-max", "9", "--out", out, "--json")
    truth, random = GroundTruthGeometry.sample(4, CONFIG), np.random.default_rng(0)
    for line in command.process.stderr:
        mark = re.match(r"pixel \d+, (\S+) (\S+) mm", line)
        if not mark:
            continue
        mark_m, count = 1e-3 * np.array([float(each) for each in mark.groups()]), len(board.of("pulse"))
        pulse = wait_for(lambda seen=count: len(p := board.of("pulse")) > seen + 1 and p[-1], "a flash")
        off_um = 1e6 * (mark_m - truth.position_m(pulse["x"], pulse["y"])) + 20.0 * random.standard_normal(2)
        command.process.stdin.write(f"{off_um[0]:.0f} {off_um[1]:.0f}\n\n")
        command.process.stdin.flush()
    status, output, errors = command.ended()
    assert status == 0, errors
    assert json.loads(output)["spots"] == 9
    assert rms_um(missed_m(load_field(out), 4)) <= 40.0
    assert_dark(board)


def test_without_an_answer_it_ends(board, start, tmp_path):
    command = start(board, "calibrate", "board", "--yes", "--manual", "--out", tmp_path / "field.toml")
    command.process.stdin.close()
    command.process.stdin = None
    status, _, errors = command.ended()
    assert status == 1
    assert "end of input" in errors
    assert_dark(board)


def test_without_a_sensor_it_requests_one(board, start, tmp_path):
    status, _, errors = start(board, "calibrate", "board", "--yes", "--out", tmp_path / "field.toml").ended()
    assert status == 2
    assert "sensor.port: missing" in errors
    assert errors.count("\n") == 1
