"""Latest state of the board as reported to the host, with each fault explained and its remedy before disarm."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.states import BoardState

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
    "SCAN": "a mirror did not follow: check the plugs of driver and position outputs, and the supply of the driver",
    "HEAD": "the scan head returned no valid status, or one without power or temperature OK: check its plug and supply",
}


def get_fault_hint(fault: str | None) -> str:
    """Return the likely cause of a fault and its acknowledgement in one sentence, '' without a fault."""
    if not fault:
        return ""
    cause = FAULT_HINTS.get(fault, "no likely cause is known; see the board's log")
    return f"{cause}; then acknowledge the fault with disarm"


@dataclass
class BoardView:
    """Latest state of the board as reported to the host."""

    state: str = "UNKNOWN"
    fault: str = ""
    inputs: int = 0
    done_index: int = 0
    queued: int = 0
    free_points: int = 0
    underruns: int = 0
    crc_errors: int = 0
    format_errors: int = 0
    seq_errors: int = 0
    laser_on_s: float = 0.0
    temperature_c: float | None = None
    uid: str = ""
    firmware: int = 0

    def apply_status(self, message: m.Status) -> None:
        """Update all fields that STATUS reports."""
        self.inputs, self.done_index, self.queued = message.inputs, message.done_index, message.queued
        self.underruns, self.crc_errors = message.underruns, message.crc_errors
        self.format_errors, self.seq_errors = message.format_errors, message.seq_errors
        self.laser_on_s = message.laser_on_us * 1e-6
        self.temperature_c = message.temperature_dc / 10.0
        self.set_state(m.STATES[message.state], m.FAULTS[message.fault])

    def set_state(self, state: str, fault: str | None = None) -> None:
        """Set the state, and the fault if the message reported one. Only FAULT has a fault."""
        self.state = state
        if fault is not None:
            self.fault = fault
        if state != BoardState.FAULT:
            self.fault = ""

    def forget_state(self) -> Self:
        """Return the view without a link: the last state would be a claim."""
        return replace(self, state="UNKNOWN", fault="")

    @classmethod
    def from_dict(cls, members: Mapping[str, Any]) -> Self:
        """Return the view whose members `to_dict` wrote."""
        known = {name: value for name, value in members.items() if name != "hint"}
        return cls(**{**known, "fault": members.get("fault") or ""})

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of the REST response, with a hint on the fault's likely cause."""
        return {**vars(self), "fault": self.fault or None, "hint": get_fault_hint(self.fault)}
