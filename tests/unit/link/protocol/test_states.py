"""The board's state machine: Python, messages.toml and the table of PROTOCOL.md state the same transitions."""

import re
import tomllib
from pathlib import Path

import pytest

from optodrive.core.errors import LocalProtocolError
from optodrive.link.protocol import states
from optodrive.link.protocol.states import TRANSITIONS, BoardState, EventReason, next_state

CONTRACT = Path(__file__).parents[4] / "firmware_protocol"
TABLE = tomllib.loads((CONTRACT / "messages.toml").read_text())
PAGE = (CONTRACT / "PROTOCOL.md").read_text()
ROOT = CONTRACT.parent
STATEMENTS = [ROOT / "optodrive/link/protocol/states.py", ROOT / "optodrive/daemon/page/board_states.js"]
STATED = {(state, event): to for state, events in TRANSITIONS.items() for event, to in events.items()}


def expand(cell):
    """States that a cell of the page's table names."""
    if cell == "any":
        return list(BoardState)
    if cell == "any but FAULT":
        return [state for state in BoardState if state != BoardState.FAULT]
    return [BoardState(name) for name in cell.split(", ")]


def test_states_and_events_have_the_order_of_the_wire():
    assert list(BoardState) == TABLE["enumerations"]["state"]
    assert list(EventReason) == TABLE["enumerations"]["reason"]


def test_groups_of_states_are_those_of_the_table():
    groups = {name: list(getattr(states, f"{name.upper()}_STATES")) for name in TABLE["state_group"]}
    assert groups == TABLE["state_group"]


def test_transitions_are_those_of_the_table():
    rows = [(state, entry["event"], entry["to"]) for entry in TABLE["transition"] for state in entry["from"]]
    assert len(rows) == len(set(rows))
    assert {(state, event): to for state, event, to in rows} == STATED


def test_transitions_are_those_of_the_page():
    section = PAGE.partition("\n## States\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| ([A-Za-z, ]+) \| [^|]+ \| ([A-Z]+) \| ([a-z, ]+) \|$", section, re.MULTILINE)
    stated = {
        (state, event): to for before, to, events in rows for state in expand(before) for event in events.split(", ")
    }
    assert stated == STATED


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
    assert TRANSITIONS[BoardState.FAULT] == {EventReason.FAULT_CLEARED: BoardState.DISARMED}


def test_no_module_states_the_states_again():
    files = [*ROOT.glob("optodrive/**/*.py"), *ROOT.glob("optodrive/daemon/page/*.js")]
    literal = re.compile(rf"""["']({"|".join(BoardState)})["']""")
    assert [str(file) for file in files if file not in STATEMENTS and literal.search(file.read_text())] == []


def test_an_event_that_the_state_does_not_know_is_an_error():
    with pytest.raises(LocalProtocolError, match="event 'start' in state DISARMED"):
        next_state(BoardState.DISARMED, EventReason.START)
