"""What the light brings is stored or has left, for every set of terms that moves heat."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optodrive.config import DisplaySection
from optodrive.neighbours import Neighbours
from optodrive.physics.model import Drive, Model
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel
from optodrive.physics.terms import known_terms

LATTICE = Neighbours.of(DisplaySection(rows=2, columns=2, pitch_m=4e-3, bridge_width_m=4e-4))
SUBSETS = [
    keys
    for size in range(len(known_terms()) + 1)
    for keys in combinations(known_terms(), size)
    if all(need in keys for key in keys for need in known_terms()[key].needs)
]


@pytest.mark.parametrize("part", range(4))
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_energy_closes(part, data):
    keys = data.draw(st.sampled_from(SUBSETS[part::4]))
    values = {
        key: {
            item.name: data.draw(st.floats(max(item.low, 5e-2 * item.high), item.high))
            for item in known_terms()[key].parameters
        }
        for key in keys
    }
    pixel = Pixel(data.draw(st.floats(95, 382)), data.draw(st.floats(80e-6, 130e-6)), 0.66, 3e-3, 4e-6, 2e-4)
    made = Model(PixelArray.uniform(pixel, len(LATTICE)), values, 293.15, LATTICE)
    power = np.array(data.draw(st.lists(st.floats(0.1, 2.45), min_size=4, max_size=4)))
    drives = [Drive(0.0, power), Drive(data.draw(st.floats(1e-3, 0.03)), 0.0 * power)]
    traced = made.trace(drives, np.array([0.01, 0.05]))
    assert traced.absorbed_j == pytest.approx(traced.stored_j + traced.left_j, rel=1e-6)
    assert traced.absorbed_j[-1] == pytest.approx(0.66 * power.sum() * drives[1].start_s, rel=1e-9)
