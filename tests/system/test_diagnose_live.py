"""`optodrive diagnose --live` on a board process whose sensor records pixels: kill -9 loses no finished run."""

import json
import signal

import pytest

from hidden_field import calibrate_hidden_field
from optodrive.lab.live_diagnosis import FIRST_ORDER
from optodrive.lab.recording import read_recording
from rig import wait_for
from signalled_processes import assert_dark_within_lease
from truth_file import write_truth

GEOMETRY = 5


@pytest.fixture
def bench(make_board, tmp_path):
    """A board with a sensor that records the pixels of a display with a leak, and the field that finds them."""
    truth = write_truth(tmp_path / "truth.toml", {"gas_leak": {"rate": 2.0}})
    calibrate_hidden_field(tmp_path / "field.toml", seed=GEOMETRY)
    return make_board(sensor=("--geometry", str(GEOMETRY), "--truth", str(truth)))


def test_a_killed_campaign_goes_on_from_its_file_to_the_hidden_cause(bench, start, tmp_path):
    folder = tmp_path / "live"
    recording = folder / "recording.h5"
    live = ("diagnose", "--live", "--yes", "--out", folder)
    field = tmp_path / "field.toml"
    command = start(bench, *live, field=field)
    wait_for(lambda: recording.exists() and len(read_recording(recording).runs) >= 2, "two recorded runs")
    command.process.send_signal(signal.SIGKILL)
    kept = read_recording(recording).runs
    command.ended()
    wait_for(lambda: bench.of("state")[-1]["state"] in ("DISARMED", "FAULT"), "the board to end")
    assert_dark_within_lease(bench)
    assert not (folder / "diagnosis.json").exists()
    played = len(bench.of("pulse"))
    assert sum(len(run.pulses) for run in kept) <= played

    status, output, errors = start(bench, *live, "--json", "-", field=field).ended()
    assert status == 0, errors
    assert f"going on with {len(kept)} runs" in errors
    answer = json.loads(output)
    assert (answer["verdict"], answer["causes"]) == ("cause", ["gas_leak"])
    assert answer["campaign"]["ended"] == "certain"
    runs = read_recording(recording).runs
    assert [run.name for run in runs[: len(kept)]] == [run.name for run in kept]
    first = runs[: len(FIRST_ORDER)]
    assert [run.attributes["group"] for run in first] == list(FIRST_ORDER)
    assert all(set(run.signals) == {"absorber_temperature_K", "displacement_m"} for run in runs)
    assert len(bench.of("pulse")) - played == sum(len(run.pulses) for run in runs[len(kept) :])
    assert bench.of("state")[-1]["state"] == "DISARMED"

    status, _, errors = start(bench, *live, field=field).ended()
    assert status == 2
    assert errors.splitlines()[-1].endswith("a folder without diagnosis.json: this campaign is complete")


def test_a_sensor_of_spots_cannot_tell_causes_apart(make_board, start, tmp_path):
    board = make_board(sensor=())
    status, _, errors = start(board, "diagnose", "--live", "--yes", "--out", tmp_path / "live").ended()
    assert status == 2
    line = errors.splitlines()[-1]
    assert "bench.toml: sensor.port: got " in line
    assert line.endswith("a sensor that records signals of a pixel; this one measures only spots and mirrors")
    assert not board.of("pulse")
