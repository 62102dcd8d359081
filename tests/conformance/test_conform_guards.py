"""B1 to B8 of PROTOCOL.md, from outside."""

import guard_scenarios
import pytest
from scenario import GUARDS, SCENARIOS

CASES = [case for case in SCENARIOS if case.module == guard_scenarios.__name__]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.subject}-{case.name}")
def test_guard(case, conforms):
    conforms(case)


def test_every_guard_is_looked_at():
    assert {case.subject for case in CASES} == set(GUARDS[:8])
