"""Explanation of each board fault, and its remedy before disarm acknowledges it."""

FAULT_HINTS = {
    "LINK": "the lease expired: the host stalled, or bytes were lost on the link",
    "RANGE": "a point lay outside the field: the configured scanner range does not match the board's",
    "ON_TIME": "one point, or several on one spot, kept the gate on longer than the board permits",
    "DUTY": "a point requested more duty than the board permits",
    "MEAN_POWER": "the mean power of the last second exceeded the board's cap",
    "CELLS": "more spots were warm at once than the board can guard",
    "PULSES": "more pulses came in a second than the board can guard",
    "SPOT": "one spot received more energy than the board permits",
    "UNDERRUN": "the queue ran empty three times within ten seconds: the host or the link is too slow",
    "INTERLOCK": "the interlock opened: close the enclosure",
    "KEY": "the key was turned off: turn it on",
    "ESTOP": "the emergency stop was pressed: release it",
}


def get_fault_hint(fault: str | None) -> str:
    """Return the likely cause of a fault and its acknowledgement in one sentence, '' without a fault."""
    if not fault:
        return ""
    cause = FAULT_HINTS.get(fault, "no likely cause is known; see the board's log")
    return f"{cause}; then acknowledge the fault with disarm"
