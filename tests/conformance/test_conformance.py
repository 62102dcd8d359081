"""Black-box conformance with PROTOCOL.md: each scenario against each kind of board.

One file, for one worker: scenarios played beside others would wait for the processor rather than for time.
"""

import guard_scenarios
import job_scenarios
import link_scenarios
import order_scenarios
import pytest
import self_scenarios
import trust_scenarios
from scenario import GUARDS, SCENARIOS

MODULES = (guard_scenarios, job_scenarios, link_scenarios, order_scenarios, self_scenarios, trust_scenarios)


@pytest.mark.parametrize("case", SCENARIOS, ids=lambda case: f"{case.subject}-{case.name}")
def test_conforms(case, conforms):
    conforms(case)


def test_every_module_and_every_guard_is_looked_at():
    assert {case.module for case in SCENARIOS} == {module.__name__ for module in MODULES}
    assert {case.subject for case in SCENARIOS} > set(GUARDS)
