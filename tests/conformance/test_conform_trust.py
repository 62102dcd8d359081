"""B9 to B15 of PROTOCOL.md, from outside."""

import order_scenarios
import pytest
import self_scenarios
import trust_scenarios
from scenario import GUARDS, SCENARIOS

MODULES = (trust_scenarios.__name__, order_scenarios.__name__, self_scenarios.__name__)
CASES = [case for case in SCENARIOS if case.module in MODULES]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.subject}-{case.name}")
def test_trust(case, conforms):
    conforms(case)


def test_every_guard_is_looked_at():
    assert {case.subject for case in CASES} == set(GUARDS[8:])
