"""The absorbed power is stored or lost, at every state and for every set of terms that stores or moves heat."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, evaluate_rates
from optodrive.physics.term import (
    ABSORBER,
    AMBIENT_K,
    BRIDGE_FLOW_W,
    CONTEXT_SIZE,
    FULL_W,
    IS_TARGET,
    NEIGHBOUR,
    POWER_W,
    WALL,
)
from optodrive.physics.term_kernels import STATE_COUNT
from optodrive.physics.terms import discover_terms
from optodrive.physics.terms.thermal import STEFAN_BOLTZMANN

KEYS = ("bridge_conductivity", "heat_capacity", "radiation", "wall_heating")
SUBSETS = [keys for size in range(len(KEYS) + 1) for keys in combinations(KEYS, size)]
ROOM_K, EPSILON = 293.15, 0.66


@pytest.mark.parametrize("keys", SUBSETS, ids="+".join)
@given(data=st.data())
def test_energy_closes(keys, data):
    values = {
        key: {item.name: data.draw(st.floats(item.low, item.high)) for item in discover_terms()[key].parameters}
        for key in keys
    }
    pixel = Pixel(data.draw(st.floats(95, 382)), data.draw(st.floats(80e-6, 130e-6)), EPSILON, 3e-3, 4e-6, 2e-4)
    power_w, theta_k = data.draw(st.floats(0.0, 2.45)), data.draw(st.floats(0.0, 600.0))
    wall_k = data.draw(st.floats(0.0, 60.0)) if "wall_heating" in keys else 0.0
    states, context, rates = np.zeros(STATE_COUNT), np.zeros(CONTEXT_SIZE), np.zeros(STATE_COUNT)
    states[ABSORBER], states[WALL] = theta_k, wall_k
    context[POWER_W], context[FULL_W], context[AMBIENT_K], context[IS_TARGET] = power_w, 2.45, ROOM_K, 1.0
    evaluate_rates(pixel, ActiveTerms.from_values(values), states, context, rates)
    capacity_j_per_k = pixel.c_j_per_k * (1.0 + values.get("heat_capacity", {}).get("slope", 0.0) * theta_k)
    stored_w = capacity_j_per_k * rates[ABSORBER]
    emitting_m2 = values.get("radiation", {}).get("emitting_area", 0.0)
    lost_w = emitting_m2 * STEFAN_BOLTZMANN * ((ROOM_K + theta_k) ** 4 - ROOM_K**4)
    if "wall_heating" in keys:
        wall = values["wall_heating"]
        stored_w += max(wall["capacity"], 0.1 / wall["resistance"]) * rates[WALL]  # no wall is faster than 0.1 s
        lost_w += wall_k / wall["resistance"]
    else:
        lost_w += context[BRIDGE_FLOW_W]
    assert stored_w + lost_w == pytest.approx(EPSILON * power_w, rel=1e-9, abs=1e-9)
    assert rates[NEIGHBOUR] == 0.0
