"""Generated from firmware_protocol/messages.toml by generate.py: do not edit."""

from enum import StrEnum
from typing import NamedTuple


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


class Transition(NamedTuple):
    """State that an event leads to, and whether queue and job are dropped."""

    to: BoardState
    drops: bool


LEASED_STATES = (BoardState.ARMING, BoardState.ARMED, BoardState.RUNNING, BoardState.HOLD)
ARMED_STATES = (BoardState.ARMED, BoardState.RUNNING, BoardState.HOLD)
IDLE_STATES = (BoardState.DISARMED, BoardState.FAULT)
TRANSITIONS = {
    (BoardState.BOOT, EventReason.BOOT): Transition(BoardState.DISARMED, drops=False),
    (BoardState.DISARMED, EventReason.ARM_REQUESTED): Transition(BoardState.ARMING, drops=False),
    (BoardState.ARMING, EventReason.ARMED): Transition(BoardState.ARMED, drops=False),
    (BoardState.ARMING, EventReason.ARMING_TIMED_OUT): Transition(BoardState.DISARMED, drops=True),
    (BoardState.ARMING, EventReason.DISARM): Transition(BoardState.DISARMED, drops=True),
    (BoardState.ARMED, EventReason.START): Transition(BoardState.RUNNING, drops=False),
    (BoardState.RUNNING, EventReason.JOB_DONE): Transition(BoardState.ARMED, drops=False),
    (BoardState.HOLD, EventReason.JOB_DONE): Transition(BoardState.ARMED, drops=False),
    (BoardState.RUNNING, EventReason.QUEUE_EMPTY): Transition(BoardState.HOLD, drops=False),
    (BoardState.RUNNING, EventReason.HOLD_TOO_LONG): Transition(BoardState.DISARMED, drops=True),
    (BoardState.RUNNING, EventReason.FAULT): Transition(BoardState.FAULT, drops=True),
    (BoardState.HOLD, EventReason.REFILLED): Transition(BoardState.RUNNING, drops=False),
    (BoardState.HOLD, EventReason.HOLD_TOO_LONG): Transition(BoardState.DISARMED, drops=True),
    (BoardState.RUNNING, EventReason.FLUSH): Transition(BoardState.ARMED, drops=True),
    (BoardState.HOLD, EventReason.FLUSH): Transition(BoardState.ARMED, drops=True),
    (BoardState.ARMED, EventReason.DISARM): Transition(BoardState.DISARMED, drops=True),
    (BoardState.RUNNING, EventReason.DISARM): Transition(BoardState.DISARMED, drops=True),
    (BoardState.HOLD, EventReason.DISARM): Transition(BoardState.DISARMED, drops=True),
    (BoardState.ARMING, EventReason.ABORT): Transition(BoardState.DISARMED, drops=True),
    (BoardState.ARMED, EventReason.ABORT): Transition(BoardState.DISARMED, drops=True),
    (BoardState.RUNNING, EventReason.ABORT): Transition(BoardState.DISARMED, drops=True),
    (BoardState.HOLD, EventReason.ABORT): Transition(BoardState.DISARMED, drops=True),
    (BoardState.ARMING, EventReason.HELLO): Transition(BoardState.DISARMED, drops=True),
    (BoardState.ARMED, EventReason.HELLO): Transition(BoardState.DISARMED, drops=True),
    (BoardState.RUNNING, EventReason.HELLO): Transition(BoardState.DISARMED, drops=True),
    (BoardState.HOLD, EventReason.HELLO): Transition(BoardState.DISARMED, drops=True),
    (BoardState.ARMING, EventReason.LINK_LOST): Transition(BoardState.DISARMED, drops=True),
    (BoardState.ARMED, EventReason.LINK_LOST): Transition(BoardState.DISARMED, drops=True),
    (BoardState.RUNNING, EventReason.LINK_LOST): Transition(BoardState.DISARMED, drops=True),
    (BoardState.HOLD, EventReason.LINK_LOST): Transition(BoardState.DISARMED, drops=True),
    (BoardState.BOOT, EventReason.FAULT): Transition(BoardState.FAULT, drops=True),
    (BoardState.DISARMED, EventReason.FAULT): Transition(BoardState.FAULT, drops=True),
    (BoardState.ARMING, EventReason.FAULT): Transition(BoardState.FAULT, drops=True),
    (BoardState.ARMED, EventReason.FAULT): Transition(BoardState.FAULT, drops=True),
    (BoardState.HOLD, EventReason.FAULT): Transition(BoardState.FAULT, drops=True),
    (BoardState.FAULT, EventReason.FAULT_CLEARED): Transition(BoardState.DISARMED, drops=True),
}
