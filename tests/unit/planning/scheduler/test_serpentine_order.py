import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.device.scan_field import IdealField
from optodrive.planning.scheduler.visiting_path import compute_serpentine_order


def test_the_beam_turns_by_twice_the_mirrors_angle():
    x_rad, y_rad = IdealField(0.22).angles_rad(np.array([0.044, 0.0]), np.array([0.0, -0.022]))
    assert x_rad == pytest.approx([0.1, 0.0])
    assert y_rad == pytest.approx([0.0, -0.05])


@given(st.lists(st.integers(0, 99), min_size=1, unique=True))
def test_serpentine_visits_each_pixel_once_and_moves_one_pitch_within_a_full_row(active):
    row, column = np.divmod(np.arange(100), 10)
    order = compute_serpentine_order(np.array(sorted(active)), row, column)
    assert sorted(order) == sorted(active)
    assert np.all(np.diff(row[order]) >= 0)


def test_serpentine_of_a_full_lattice_has_no_long_move():
    row, column = np.divmod(np.arange(100), 10)
    order = compute_serpentine_order(np.arange(100), row, column)
    steps = np.maximum(np.abs(np.diff(row[order])), np.abs(np.diff(column[order])))
    assert steps.max() == 1
