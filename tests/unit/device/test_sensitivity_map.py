"""Sensitivity maps: the file, and its effect on the heights of intensities."""

from pathlib import Path

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.device.sensitivity_map import (
    SensitivityMap,
    load_sensitivity_map,
    replace_sensitivity_map,
    write_sensitivity_map,
)
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli.sequence_file import parse_sequence

CONFIG, COUNT = DISPLAYS["display-16"].config, len(DISPLAYS["display-16"].layout)
FRAME = {"show_at_s": 0.0, "duration_s": 1.0}


def some_map():
    sensitivity = np.random.default_rng(3).uniform(0.6, 1.6, COUNT)
    return SensitivityMap(sensitivity, np.full(COUNT, 0.05), "p07", 400)


@pytest.fixture
def equalised(tmp_path):
    path = tmp_path / "sensitivity.toml"
    write_sensitivity_map(path, some_map(), CONFIG, {"source": "a test"})
    return replace_sensitivity_map(CONFIG, path)


def test_there_and_back(equalised):
    again = load_sensitivity_map(equalised)
    assert again.sensitivity == pytest.approx(some_map().sensitivity, rel=1e-4)
    assert again.sigma == pytest.approx(some_map().sigma, rel=1e-4)
    assert (again.participant, again.trials, len(again)) == ("p07", 400, COUNT)
    assert load_sensitivity_map(CONFIG) is None


def test_an_intensity_is_equalised_and_a_height_is_not(equalised):
    by_name = {str(pixel): 4 for pixel in range(COUNT)}
    plain, felt = (parse_sequence({"frames": [FRAME | {"intensity": by_name}]}, c, "f") for c in (CONFIG, equalised))
    ratio, sensitivity = felt.frames[0].target_m / plain.frames[0].target_m, some_map().sensitivity
    order = np.argsort(sensitivity)
    assert (np.diff(ratio[order]) < 0).all()  # the more sensitive, the lower
    assert ((ratio < 1) == (sensitivity > 1)).all()
    at_height = FRAME | {"target_um": dict.fromkeys(by_name, 80)}
    heights = [
        parse_sequence({"frames": [at_height]}, config, "f").frames[0].target_m for config in (CONFIG, equalised)
    ]
    np.testing.assert_array_equal(*heights)


def test_a_configuration_names_a_map_in_its_own_folder(tmp_path):
    (tmp_path / "display.toml").write_text(
        locate_shipped("display-16.toml")
        .read_text()
        .replace("[display]\n", '[display]\nsensitivity_map = "p07.toml"\n', 1)
    )
    write_sensitivity_map(tmp_path / "p07.toml", some_map(), CONFIG, {})
    assert load_sensitivity_map(load_config(str(tmp_path / "display.toml"))).participant == "p07"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('format = "optodrive-sensitivity"', 'format = "optodrive-pixels"', "format: got 'optodrive-pixels'"),
        ("version = 1", "version = 2", "version: got 2"),
        ("index = 0,", "index = 1,", "map.pixels: got '16 entries', expected one entry per pixel, 0 to 15 in order"),
        ('participant = "p07"', 'participant = "Anna B."', "map.participant: got 'Anna B.'"),
        ("rows = 4", "rows = 5", "display.rows: got 5, expected 4"),
        ("sensitivity_sigma = 0.05 },", "sensitivity_sigma = -0.05 },", "sensitivity_sigma: got -0.05"),
    ],
)
def test_a_damaged_map_is_refused_in_one_line(equalised, old, new, says):
    path = Path(equalised.display.sensitivity_map)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as refused:
        load_sensitivity_map(equalised)
    assert says in str(refused.value), str(refused.value)
    with pytest.raises(InputError, match=r"sensitivity\.toml"):
        DisplayModel.from_config(equalised)
    assert "\n" not in str(refused.value)


def test_a_map_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        load_sensitivity_map(replace_sensitivity_map(CONFIG, tmp_path / "none.toml"))
