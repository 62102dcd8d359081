"""The board in JavaScript passes the conformance suite, and broken ones do not: PROTOCOL.md says all that it tests."""

import pytest
from all_scenarios import SCENARIOS
from independent_board import IndependentCore, independent_kind
from process_board import has_subject
from scenario import GUARDS, judge
from test_conform_mutants import caught_by
from test_conformance_pty import name_case
from virtual_rig import VirtualRig, run_fault_sessions

LINK_FAULTS = 5000


@pytest.mark.parametrize(
    "case", [case for case in SCENARIOS if has_subject("independent", case.subject)], ids=name_case
)
def test_conforms(case):
    judge(independent_kind(), case)


@pytest.mark.parametrize("guard", [guard for guard in GUARDS if has_subject("independent", guard)])
def test_a_board_without_a_guard_is_caught(guard):
    assert caught_by(independent_kind(guard), guard), "passes every scenario of its guard"


def test_the_host_of_the_package_plays_on_it_over_a_faulty_line():
    rig = VirtualRig(6, 0.05, extra=0.6, pauses=0.001, make_core=IndependentCore)
    sessions, pulses = run_fault_sessions(rig, LINK_FAULTS)
    print(f"{rig.faults} faults, {sessions} sessions, {pulses} pulses")
    assert pulses > 0
    rig.core.close()
