"""The board's state machine: what holds for the transitions of messages.toml, from which C and Python come."""

import re
from pathlib import Path

import pytest

from optodrive.core.errors import LocalProtocolError
from optodrive.link.protocol import states
from optodrive.link.protocol.states import TRANSITIONS, BoardState, EventReason, find_transition

CONTRACT = Path(__file__).parents[4] / "firmware_protocol"
ROOT = CONTRACT.parent
STATEMENTS = [ROOT / "optodrive/link/protocol/state_table.py", ROOT / "optodrive/daemon/page/board_states.js"]
STATED = {key: transition.to for key, transition in TRANSITIONS.items()}


def test_whatever_ends_in_disarmed_or_fault_drops_the_queue():
    kept = {event for (_, event), transition in TRANSITIONS.items() if not transition.drops}
    assert {event for (_, event), transition in TRANSITIONS.items() if transition.drops}.isdisjoint(kept)
    ends = {EventReason.BOOT} | {event for (_, event), to in STATED.items() if to not in states.IDLE_STATES}
    assert kept == ends - {EventReason.FLUSH}


def test_an_event_always_leads_to_the_same_state():
    for event in EventReason:
        assert len({to for (_, known), to in STATED.items() if known == event}) == (event != EventReason.NONE)


def test_each_state_is_reached_and_left():
    assert set(STATED.values()) == set(BoardState) - {BoardState.BOOT}
    assert {state for state, _ in STATED} == set(BoardState)


def test_only_the_arming_sequence_leads_to_armed_states():
    entries = {
        (state, event)
        for (state, event), to in STATED.items()
        if to in states.ARMED_STATES and state not in states.ARMED_STATES
    }
    assert entries == {(BoardState.ARMING, EventReason.ARMED)}
    assert [key for key, to in STATED.items() if to == BoardState.ARMING] == [
        (BoardState.DISARMED, EventReason.ARM_REQUESTED)
    ]


def test_a_fault_is_left_only_by_clearing_it():
    leaving = {event: to for (state, event), to in STATED.items() if state == BoardState.FAULT}
    assert leaving == {EventReason.FAULT_CLEARED: BoardState.DISARMED}


def test_no_module_states_the_states_again():
    files = [*ROOT.glob("optodrive/**/*.py"), *ROOT.glob("optodrive/daemon/page/*.js")]
    literal = re.compile(rf"""["']({"|".join(BoardState)})["']""")
    assert [str(file) for file in files if file not in STATEMENTS and literal.search(file.read_text())] == []


def test_an_event_that_the_state_does_not_know_is_an_error():
    with pytest.raises(LocalProtocolError, match="event 'start' in state DISARMED"):
        find_transition(BoardState.DISARMED, EventReason.START)
