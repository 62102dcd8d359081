"""Latest state of the board as reported to the host."""

from dataclasses import asdict, dataclass
from typing import Any

from optodrive.link.session.fault_hints import get_fault_hint


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

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of the REST response, with a hint on the fault's likely cause."""
        return {**asdict(self), "fault": self.fault or None, "hint": get_fault_hint(self.fault)}
