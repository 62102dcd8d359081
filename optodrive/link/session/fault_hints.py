"""What a board's fault means and what to do, in plain words."""

FAULT_HINTS = {
    "LINK": "the board heard no lease in time: the host stalled, or bytes were lost on the way",
    "RANGE": "a point lay outside the field: the scanner's range in the configuration does not match the board's",
    "ON_TIME": "a point, or several on one spot, kept the gate on longer than the board allows",
    "DUTY": "a point asked for more duty than the board allows",
    "MEAN_POWER": "the mean power of the last second passed the board's cap",
    "SPOT": "one spot was given more energy than the board allows",
    "UNDERRUN": "the queue ran empty three times in ten seconds: the host or the link is too slow",
    "INTERLOCK": "the interlock opened: close the enclosure, then acknowledge with disarm",
    "KEY": "the key was turned off: turn it on, then acknowledge with disarm",
    "ESTOP": "the emergency stop was pressed: release it, then acknowledge with disarm",
}


def get_fault_hint(fault: str | None) -> str:
    """A sentence on a fault's likely cause; says so where none is known."""
    if not fault:
        return ""
    return FAULT_HINTS.get(fault, "no likely cause is known; look at the board's log")
