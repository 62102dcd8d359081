"""Control of the board: who armed it, and since when."""

from typing import Any, NamedTuple


class Control(NamedTuple):
    """One arming. caller: name of the token that requested it; requested_s: host time of the request."""

    caller: str
    requested_s: float

    def to_dict(self, now_s: float) -> dict[str, Any]:
        """Return the fields of the status at a host time, s."""
        return {"caller": self.caller, "armed_for_s": now_s - self.requested_s}
