"""Checks of valid and invalid spots."""

import numpy as np
import pytest

from hidden_field import CONFIG, PRIOR, grid_codes, measure_spots, random_codes
from optodrive.core.errors import InputError
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.spot_checks import check_fit, check_spots
from optodrive.lab.calibration.spots import MeasuredSpots, read_spots, write_spots
from optodrive.link.simulator.true_geometry import GroundTruthGeometry

RANDOM = np.random.default_rng(4)
MANY, NINE, SIX = (
    measure_spots(GroundTruthGeometry.sample(seed, CONFIG), codes, RANDOM, share)[0].to_table()
    for seed, codes, share in ((0, grid_codes(17), 0.2), (1, grid_codes(3), 0.0), (2, random_codes(RANDOM, 6), 0.0))
)


def collapse_to_one_place(table, noise_m):
    return np.column_stack(
        [table[:, :2], [1e-3, 2e-3] + noise_m * np.random.default_rng(1).standard_normal((len(table), 2))]
    )


WRONG_TABLES = {
    "x mirrored": lambda t: t * [1, 1, -1, 1],
    "y mirrored": lambda t: t * [1, 1, 1, -1],
    "half a turn": lambda t: t * [1, 1, -1, -1],
    "exchanged": lambda t: t[:, [0, 1, 3, 2]],
    "quarter turn": lambda t: t[:, [0, 1, 3, 2]] * [1, 1, -1, 1],
    "inches": lambda t: t / [1, 1, 0.0254, 0.0254],
    "millimetres": lambda t: t * [1, 1, 1e3, 1e3],
    "micrometres": lambda t: t * [1, 1, 1e6, 1e6],
    "distances (2|1.99)": lambda t: t * [1, 1, 2, 2],
    "all spots were measured at one place": lambda t: collapse_to_one_place(t, 1e-5),
    "this mirror does not move": lambda t: np.column_stack([t[:, :2], np.full(len(t), 1e-3), t[:, 3]]),
    "on a line": lambda t: t[:, [0, 0, 2, 2]],
    "several places": lambda t: np.column_stack([np.full((len(t), 2), 3e4), t[:, 2:]]),
    "at least 6": lambda t: t[:5],
    "nearly all look like outliers": lambda t: np.column_stack(
        [t[:, :2], np.random.default_rng(2).uniform(-0.036, 0.036, (len(t), 2))]
    ),
    "turned by": lambda t: np.column_stack([t[:, :2], t[:, 2:] @ [[0.9, 0.44], [-0.44, 0.9]]]),
    "middle": lambda t: t + np.array([0, 0, 0.02, 0]),
}


@pytest.mark.parametrize("table", [MANY, NINE, SIX], ids=["289", "9", "6"])
def test_valid_spots_pass(table):
    check_spots("spots.csv", MeasuredSpots.from_table(table), PRIOR)
    check_fit("spots.csv", fit_field(MeasuredSpots.from_table(table), PRIOR))


@pytest.mark.parametrize("named", WRONG_TABLES)
@pytest.mark.parametrize("table", [MANY, NINE, SIX], ids=["289", "9", "6"])
def test_the_cause_of_invalid_spots_is_named(named, table):
    with pytest.raises(InputError, match=named) as caught:
        check_spots("spots.csv", MeasuredSpots.from_table(WRONG_TABLES[named](table)), PRIOR)
    assert "\n" not in str(caught.value)
    assert "…" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("x,y,x_m,y_m\n1,2,3,4\n", "first line"),
        ("x_code,y_code,x_m,y_m\n1,2,3\n", "row 2"),
        ("x_code,y_code,x_m,y_m\n1,2,0.1,0.2\n1,2,here,0\n", "row 3: x_m: got 'here'"),
        ("x_code,y_code,x_m,y_m\n1,2,nan,0\n", "row 2: x_m"),
        ("x_code,y_code,x_m,y_m\n1,70000,0,0\n", "row 2: y_code"),
        ("# optodrive spots of mine\nx_code,y_code,x_m,y_m\n1,70000,0,0\n", "row 3: y_code"),
        ("# a note\n# another\nx_code,y_code,x_m,y_m\n1,x,0,0\n", "row 4: y_code"),
        ("# a note\nx_code,y_code,x_m\n1,2,0\n", "line 2"),
        ("x_code,y_code,x_m,y_m\n0.01,0.02,32768,32768\n", "exchanged"),
        ("x_code,y_code,x_m,y_m\n0.01,0.02,0.01,0.02\n", "look like metres"),
    ],
)
def test_a_file_without_spots_is_refused(tmp_path, text, named):
    path = tmp_path / "spots.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=named):
        read_spots(path)


def test_spots_round_trip(tmp_path):
    write_spots(tmp_path / "spots.csv", MeasuredSpots.from_table(MANY), "mine")
    assert np.allclose(read_spots(tmp_path / "spots.csv").to_table(), MANY, atol=1e-10)


def test_spots_of_another_display_are_refused_by_name(tmp_path):
    path = tmp_path / "spots.csv"
    write_spots(path, MeasuredSpots.from_table(MANY), "mine")
    assert len(read_spots(path, "mine")) == len(read_spots(path)) == len(MANY)
    with pytest.raises(InputError, match="spots: got 'those of mine', expected those of yours"):
        read_spots(path, "yours")
    path.write_text(path.read_text().partition("\n")[2])  # a table of a user's own
    assert len(read_spots(path, "yours")) == len(MANY)
