"""The board's state machine: its states, its events, and the transition that each event causes.

firmware_protocol/messages.toml states the same table for the firmware, independently; a test compares the two.
"""

from enum import StrEnum

from optodrive.core.errors import LocalProtocolError


class BoardState(StrEnum):
    """A state of the board, in the order of its number on the wire."""

    BOOT = "BOOT"
    DISARMED = "DISARMED"
    ARMING = "ARMING"
    ARMED = "ARMED"
    RUNNING = "RUNNING"
    HOLD = "HOLD"
    FAULT = "FAULT"


class EventReason(StrEnum):
    """An event of the state machine, as EVENT reports it, in the order of its number on the wire."""

    NONE = ""
    BOOT = "boot"
    HELLO = "hello"
    ARM_REQUESTED = "arm requested"
    ARMED = "armed"
    START = "start"
    JOB_DONE = "job done"
    QUEUE_EMPTY = "queue empty"
    REFILLED = "refilled"
    HOLD_TOO_LONG = "hold too long"
    DISARM = "disarm"
    ABORT = "abort"
    LINK_LOST = "link lost"
    ARMING_TIMED_OUT = "arming timed out"
    FAULT = "fault"
    FAULT_CLEARED = "fault cleared"
    FLUSH = "flush"


LEASED_STATES = (BoardState.ARMING, BoardState.ARMED, BoardState.RUNNING, BoardState.HOLD)
"""States that require a lease."""
ARMED_STATES = (BoardState.ARMED, BoardState.RUNNING, BoardState.HOLD)
"""States that accept points."""
UNARMED_STATES = tuple(state for state in BoardState if state not in ARMED_STATES)
"""States that end a plan."""
IDLE_STATES = (BoardState.DISARMED, BoardState.FAULT)
"""States that accept limits and that DISARM, ABORT and HELLO do not change."""

_LEAVE_ARMED = {
    EventReason.DISARM: BoardState.DISARMED,
    EventReason.ABORT: BoardState.DISARMED,
    EventReason.HELLO: BoardState.DISARMED,
    EventReason.LINK_LOST: BoardState.DISARMED,
    EventReason.FAULT: BoardState.FAULT,
}
TRANSITIONS: dict[BoardState, dict[EventReason, BoardState]] = {
    BoardState.BOOT: {
        EventReason.BOOT: BoardState.DISARMED,
        EventReason.FAULT: BoardState.FAULT,
    },
    BoardState.DISARMED: {
        EventReason.ARM_REQUESTED: BoardState.ARMING,
        EventReason.FAULT: BoardState.FAULT,
    },
    BoardState.ARMING: {
        EventReason.ARMED: BoardState.ARMED,
        EventReason.ARMING_TIMED_OUT: BoardState.DISARMED,
        **_LEAVE_ARMED,
    },
    BoardState.ARMED: {
        EventReason.START: BoardState.RUNNING,
        **_LEAVE_ARMED,
    },
    BoardState.RUNNING: {
        EventReason.JOB_DONE: BoardState.ARMED,
        EventReason.QUEUE_EMPTY: BoardState.HOLD,
        EventReason.HOLD_TOO_LONG: BoardState.DISARMED,
        EventReason.FLUSH: BoardState.ARMED,
        **_LEAVE_ARMED,
    },
    BoardState.HOLD: {
        EventReason.REFILLED: BoardState.RUNNING,
        EventReason.JOB_DONE: BoardState.ARMED,
        EventReason.HOLD_TOO_LONG: BoardState.DISARMED,
        EventReason.FLUSH: BoardState.ARMED,
        **_LEAVE_ARMED,
    },
    BoardState.FAULT: {
        EventReason.FAULT_CLEARED: BoardState.DISARMED,
    },
}
"""The state after each event, by the state before it; any other event is an error in that state."""


def next_state(state: BoardState, event: EventReason) -> BoardState:
    """Return the state that an event leads to. Raise LocalProtocolError for an event that the state does not know."""
    try:
        return TRANSITIONS[state][event]
    except KeyError:
        raise LocalProtocolError(f"event {event.value!r} in state {state.value}, expected none") from None
