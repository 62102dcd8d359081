"""Parts of the measurement loop: robust mean, session file, worker process."""

import json
from pathlib import Path

import numpy as np
import pytest

from displays import DISPLAYS
from exclusive_rig import ExclusiveRig
from optodrive.core.errors import InputError, OptodriveError, RefusedError
from optodrive.core.worker_process import WorkerProcess
from optodrive.device.config import Config
from optodrive.lab.calibration.spots import MeasuredSpots
from optodrive.lab.commissioning.measurement_loop import CalibrationSession, SpotRow, save_text, session_path_for
from optodrive.lab.commissioning.sensor import SensorReader, SpotReading, SpotSensorClient, robust_mean
from optodrive.lab.commissioning.spot_locator import SensorLocator
from optodrive.link.transport.serial_port import SerialPort
from optodrive.planning.display_model import DisplayModel

CONFIG = DISPLAYS["display-437"].config


def refuse(where):
    raise InputError(where, 1, "2")


def test_one_reflection_among_three_changes_nothing():
    true = [SpotReading(1e-3, 2e-3, 1e-5), SpotReading(1.01e-3, 2.01e-3, 1e-5)]
    seen = robust_mean([true[0], SpotReading(-0.03, 0.01, 1e-5), true[1]])
    assert seen.x_m == pytest.approx(1.005e-3)
    assert seen.y_m == pytest.approx(2.005e-3)
    assert seen.sigma_m == pytest.approx(1e-5 / 2**0.5)
    assert robust_mean(true[:1]) == true[0]


def test_a_session_goes_on(tmp_path):
    out = tmp_path / "field.toml"
    session = CalibrationSession.load_or_create(out, CONFIG)
    assert len(session.spots) == 0
    session.rows.append(SpotRow(1.0, 2.0, 3e-3, 4e-3))
    save_text(session.path, session.to_json())
    again = CalibrationSession.load_or_create(out, CONFIG)
    assert again.rows == session.rows
    assert again.spots.to_table().tolist() == [[1.0, 2.0, 3e-3, 4e-3]]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"display": "display-1"}, "display: got 'display-1', expected 'display-437'"),
        ({"version": 2}, "version: got 2, expected 1"),
        ({"spots": [[1, 2, 3]]}, "rows of x_code, y_code, x_m, y_m"),
        ({"spots": [[1, 2, 3, float("nan")]]}, "not finite"),
    ],
)
def test_a_session_of_something_else_is_refused(tmp_path, change, says):
    out = tmp_path / "field.toml"
    about = json.loads(CalibrationSession.load_or_create(out, CONFIG).to_json())
    session_path_for(out).write_text(json.dumps(about | change))
    with pytest.raises(InputError, match=r"field\.toml\.session\.json") as caught:
        CalibrationSession.load_or_create(out, CONFIG)
    assert says in str(caught.value)


def test_work_aside_comes_back_or_says_why():
    with WorkerProcess() as worker:
        worker.submit(str.upper, "spot")
        assert worker.result() == "SPOT"
        worker.submit(refuse, "a file")
        with pytest.raises(RefusedError, match="a file: got 1, expected 2"):
            worker.result()
        worker.submit(Path.read_text, Path("/nowhere at all"))
        with pytest.raises(OptodriveError, match="read_text: FileNotFoundError"):
            worker.result()
        worker._process.terminate()
        with pytest.raises(OptodriveError, match="has ended"):
            worker.result()


@pytest.mark.parametrize("empty_columns", [0, 3])
def test_every_place_of_a_sensor_s_grid_is_told_from_the_others(empty_columns):
    """Also where all pixels lie on one side: a place that looks like another would be measured without end."""
    table = DISPLAYS["display-16"].config.model_dump()
    table["display"] |= {"missing": [[row, column] for row in range(4) for column in range(empty_columns)]}
    rig = ExclusiveRig(DisplayModel.from_config(Config.model_validate(table)), lambda x_code, y_code, at_us: None)
    sensor = SensorReader(rig.held, SpotSensorClient(SerialPort("/dev/null", 115_200)), rig.clock)
    locator = SensorLocator(rig.held, sensor, 5e-3, 3)
    codes = locator.candidate_codes(None)
    spots = MeasuredSpots.from_table(np.column_stack([codes, np.zeros_like(codes)]))
    assert locator.match_places(spots).tolist() == list(range(len(codes)))
    for x_code, y_code in codes:
        rig.held.check_range(int(x_code), int(y_code))
