"""What the light brings is stored or has left, for every set of terms that moves heat."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optodrive.device.config import DisplaySection
from optodrive.device.neighbours import Neighbours
from optodrive.physics.numpy_model import STEPS, Drive, Model
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel
from optodrive.physics.terms import discover_terms

LATTICE = Neighbours.from_display(DisplaySection(rows=2, columns=2, pitch_m=4e-3, bridge_width_m=4e-4))
TERMS = {key: term for key, term in discover_terms().items() if term.is_display_term}
LAGS_S = st.floats(1e-3, 64e-3)
SUBSETS = [
    keys
    for size in range(len(TERMS) + 1)
    for keys in combinations(TERMS, size)
    if all(need in keys for key in keys for need in TERMS[key].requires)
]


HEAT = ("bridge_conductivity", "wall_heating", "lateral_conduction")
POWERS = st.lists(st.floats(0.1, 2.45), min_size=4, max_size=4).map(np.array)


@st.composite
def models(draw, keys):
    """A model of these terms, with parameters from all of their plausible ranges."""
    values = {key: {item.name: draw(st.floats(item.low, item.high)) for item in TERMS[key].parameters} for key in keys}
    pixel = Pixel(draw(st.floats(95, 382)), draw(st.floats(80e-6, 130e-6)), 0.66, draw(LAGS_S), 4e-6, 2e-4)
    return Model(PixelArray.uniform(pixel, len(LATTICE)), values, 293.15, LATTICE)


@pytest.mark.parametrize("keys", SUBSETS, ids="+".join)
@settings(max_examples=4, deadline=None)
@given(data=st.data(), power=POWERS, lit_s=st.floats(1e-3, 0.03))
def test_energy_closes(keys, data, power, lit_s):
    made = data.draw(models(keys))
    traced = made.trace([Drive(0.0, power), Drive(lit_s, 0.0 * power)], np.array([0.01, 0.05]))
    assert traced.absorbed_j == pytest.approx(traced.stored_j + traced.left_j, rel=1e-6)
    assert traced.absorbed_j[-1] == pytest.approx(0.66 * power.sum() * lit_s, rel=1e-9)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(made=models(HEAT), power=POWERS, lit_s=st.floats(1e-3, 0.03))
def test_half_the_step_changes_nothing(made, power, lit_s):
    # The balance closes at any step, right or wrong: this is what says that the motion is right.
    drives = [Drive(0.0, power), Drive(lit_s, 0.0 * power)]
    coarse, fine = (made.trace(drives, np.array([0.02, 0.06]), steps=steps) for steps in (STEPS, 2 * STEPS))
    for state, rise_k in fine.rise_k.items():
        assert coarse.rise_k[state] == pytest.approx(rise_k, rel=1e-6, abs=1e-6 * rise_k.max())
