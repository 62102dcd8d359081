"""A parameter set whose terms the limiter's bound does not hold for is refused by name."""

import pytest

from displays import DISPLAYS
from optodrive.errors import InputError
from optodrive.guard import BOUNDED, budget_of
from optodrive.physics.parameters import Parameter, load_parameters
from optodrive.physics.terms import known_terms

DISPLAY = DISPLAYS["display-16"]


def with_term(key):
    values = {
        item.name: Parameter(value=max(item.default, item.low), unit=item.unit, source="here")
        for item in known_terms()[key].parameters
    }
    base = load_parameters("surroundings")
    return base.model_copy(update={"terms": {**base.terms, key: values}})


@pytest.mark.parametrize("key", sorted(known_terms()))
def test_only_terms_that_the_bound_knows_or_that_never_warm_are_taken(key):
    taken = key in BOUNDED or known_terms()[key].never_warmer
    if taken:
        budget_of(DISPLAY.config, with_term(key), DISPLAY.pixels)
    else:
        with pytest.raises(InputError, match=f"terms.{key}"):
            budget_of(DISPLAY.config, with_term(key), DISPLAY.pixels)


def test_the_terms_that_may_warm_are_these():
    warming = {key for key, term in known_terms().items() if key not in BOUNDED and not term.never_warmer}
    assert warming == {
        "heat_capacity",
        "neighbour_crosstalk",
        "power_nonlinearity",
        "absorber_ageing",
        "beam_misalignment",
        "ambient_drift",
    }
