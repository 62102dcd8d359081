"""The board in JavaScript passes the conformance suite, and broken ones do not: PROTOCOL.md says all that it tests."""

import pytest
from all_scenarios import SCENARIOS
from independent_board import independent_kind
from scenario import GUARDS, judge
from test_conform_mutants import caught_by
from test_conformance_pty import name_case


@pytest.mark.parametrize("case", SCENARIOS, ids=name_case)
def test_conforms(case):
    judge(independent_kind(), case)


@pytest.mark.parametrize("guard", GUARDS)
def test_a_board_without_a_guard_is_caught(guard):
    assert caught_by(independent_kind(guard), guard), "passes every scenario of its guard"
