import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.plan.field import IdealField
from optodrive.plan.order import serpentine


def test_field_there_and_back():
    field = IdealField(0.22)
    position = np.linspace(-0.076, 0.076, 9)
    assert np.allclose(field.position_m(field.mirror_rad(position)), position, atol=1e-15)
    assert field.mirror_rad(np.array([0.044]))[0] == pytest.approx(0.1)


@given(st.lists(st.integers(0, 99), min_size=1, unique=True))
def test_serpentine_visits_each_pixel_once_and_moves_one_pitch_within_a_full_row(active):
    row, column = np.divmod(np.arange(100), 10)
    order = serpentine(np.array(sorted(active)), row, column)
    assert sorted(order) == sorted(active)
    assert np.all(np.diff(row[order]) >= 0)


def test_serpentine_of_a_full_lattice_has_no_long_move():
    row, column = np.divmod(np.arange(100), 10)
    order = serpentine(np.arange(100), row, column)
    steps = np.maximum(np.abs(np.diff(row[order])), np.abs(np.diff(column[order])))
    assert steps.max() == 1
