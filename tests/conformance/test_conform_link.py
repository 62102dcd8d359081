"""PROTOCOL.md beyond its guards, from outside: link, messages, jobs, reports."""

import job_scenarios
import link_scenarios
import pytest
from scenario import SCENARIOS

MODULES = (link_scenarios.__name__, job_scenarios.__name__)
CASES = [case for case in SCENARIOS if case.module in MODULES]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.subject}-{case.name}")
def test_link(case, conforms):
    conforms(case)
