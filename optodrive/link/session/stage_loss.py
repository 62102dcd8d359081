"""The loss of one of several boards after which the others go on."""

from typing import Any, Literal, NamedTuple

OnStageLoss = Literal["all_dark", "that_stage"]
LEASE_TRANSIT_MAX_S = 0.06
"""Longest time from the host's last write to a board until its last lease begins there, and the skew of its clock.

Bytes in flight take 10 ms, twice that with a retransmission; USB adapters and drivers hold bytes for up to 16 ms.
"""


class LostStage(NamedTuple):
    """A stage that was lost while all were armed.

    reason: for people, without the stage's name
    dark_s: host time from which its board is dark for certain, even if nothing has reached it since: its lease has
    ended
    """

    stage: int
    reason: str
    dark_s: float

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of the status."""
        return self._asdict()
