"""Black-box conformance with PROTOCOL.md in real time: board processes on ptys, some at once.

Every run plays IN_EVERY_RUN: what real time, a real port and a process can change. scripts/test --slow plays all.
"""

import pytest
from all_scenarios import SCENARIOS
from process_board import PROCESS_KINDS, has_subject
from scenario import run_all

IN_EVERY_RUN = (
    "hello_reply_describes_the_board",
    "hello_is_accepted_in_any_session_and_ends_the_job",
    "tick_is_a_microsecond_and_host_t_is_returned",
    "sessions_and_nonces_do_not_repeat",
    "arming_takes_at_least_two_seconds",
    "status_and_events_agree_with_the_log",
    "gate_turns_off_in_time_with_and_without_more_points",
    "only_a_lease_of_this_session_prevents_fault_link-RUNNING",
    "abort_is_accepted_in_any_session",
    "reopened_port_is_not_armed",
    "unsafe_input_is_latched_until_cleared-interlock",
    "leaving_running_turns_the_gate_off_first-closed port",
    "external_event_turns_the_gate_off_at_once-a reset",
    "refused_frames_count_as_specified",
    "internal_fault_is_immediate_and_latched-a late tick",
    "internal_fault_is_immediate_and_latched-a gate that sticks",
    "stopped_main_loop_ends_in_a_reset_that_hello_reports",
)


@pytest.fixture(scope="module", params=[kind.name for kind in PROCESS_KINDS])
def board_kind(request, ready):
    return ready(request.param, 0)


@pytest.fixture(scope="module")
def outcomes(board_kind, request):
    """Return the futures of this module's selected scenarios, by name."""
    here = [item for item in request.session.items if item.module is request.module and hasattr(item, "callspec")]
    requested = {item.callspec.params["case"].name: item.callspec.params["case"] for item in here}
    futures = run_all(board_kind, [case for case in requested.values() if has_subject(board_kind.name, case.subject)])
    yield futures
    for future in futures.values():
        future.cancel()


def in_every_run(case):
    return case.name in IN_EVERY_RUN


def name_case(case):
    return f"{case.subject}-{case.name}"


def list_cases(name, without=None):
    """Return the scenarios of a kind of board without those of another one. Only some are played in every run."""
    return [
        case if in_every_run(case) else pytest.param(case, marks=pytest.mark.slow)
        for case in SCENARIOS
        if has_subject(name, case.subject) and not (without and has_subject(without, case.subject))
    ]


@pytest.mark.parametrize("case", list_cases("python"), ids=name_case)
def test_conforms(case, board_kind, outcomes):
    outcomes[case.name].result()


@pytest.mark.parametrize("board_kind", ["host"], indirect=True)
@pytest.mark.parametrize("case", list_cases("host", without="python"), ids=name_case)
def test_conforms_beyond_the_simulated_board(case, board_kind, outcomes):
    outcomes[case.name].result()


def test_every_selected_scenario_exists():
    assert set(IN_EVERY_RUN) <= {case.name for case in SCENARIOS}
