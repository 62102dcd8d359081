"""Planning with the diagnosed model corrects the height errors of a hidden effect."""

import pytest

from blind_lab import draw_case
from blind_loop import close_discovery_loop, close_loop

SEED = 9_700_000
"""A development seed; `scripts/bench loop` covers all causes."""


@pytest.mark.parametrize("cause", ["laser_turn_on", pytest.param("membrane_creep", marks=pytest.mark.slow)])
def test_planning_with_the_diagnosed_model_takes_most_of_the_error_away(cause, tmp_path):
    loop = close_loop(draw_case("single", SEED, tmp_path, cause=cause), tmp_path)
    assert loop.trimmed == 0
    assert loop.nominal > 0.01
    assert loop.error_reduction >= 0.8, loop


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("mechanism", ["slack_membrane", "melting", "second_node"])
def test_planning_with_a_discovered_term_takes_most_of_the_error_away(mechanism, tmp_path):
    """The mechanisms outside the catalogue that change heights and that no instrument or chance hides in the light."""
    loop = close_discovery_loop(draw_case("unknown", SEED, tmp_path, mechanism=mechanism), tmp_path)
    assert loop is not None
    assert loop.trimmed == 0
    assert loop.nominal > 0.01
    assert loop.error_reduction >= 0.8, loop
