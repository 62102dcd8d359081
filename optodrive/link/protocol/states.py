"""The board's state machine. States, events and transitions come from firmware_protocol/messages.toml."""

from optodrive.core.errors import LocalProtocolError
from optodrive.link.protocol.state_table import (
    ARMED_STATES,
    IDLE_STATES,
    LEASED_STATES,
    TRANSITIONS,
    BoardState,
    EventReason,
    Transition,
)

__all__ = [
    "ARMED_STATES",
    "IDLE_STATES",
    "LEASED_STATES",
    "TRANSITIONS",
    "UNARMED_STATES",
    "BoardState",
    "EventReason",
    "find_transition",
]

UNARMED_STATES = tuple(state for state in BoardState if state not in ARMED_STATES)
"""States that end a plan."""


def find_transition(state: BoardState, event: EventReason) -> Transition:
    """Return the transition of an event. Raise LocalProtocolError for an event that the state does not know."""
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        raise LocalProtocolError(f"event {event.value!r} in state {state.value}, expected none") from None
