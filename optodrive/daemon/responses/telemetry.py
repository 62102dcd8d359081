"""The events of GET /v1/telemetry, except `state`, which is a StateReport."""

from collections.abc import Mapping

from optodrive.core.json_model import FloatColumn, IntColumn, JsonModel, TextColumn
from optodrive.daemon.responses.state import StateReport


class FaultEvent(JsonModel):
    """A fault of the board or the link. All members except the states are null or empty without one."""

    board: str
    link: str
    fault: str | None
    hint: str
    link_error: str | None


class DisplayEvent(JsonModel):
    """Every pixel at a board time: base64 of little-endian u16, heights in 0.1 µm, temperatures in 0.1 °C.

    height, absorber: at the board time
    height_peak, absorber_peak: the largest since the previous event that the reader received, also the height to which
    a pulse that was executed since then still raises the pixel
    """

    board_s: float
    warm: bool
    height: str
    height_peak: str
    absorber: str
    absorber_peak: str


class PulseBatch(JsonModel):
    """Pulses of one plan by column. `row` counts in the plan, and `start_s` is board time."""

    plan: str
    name: str
    row: IntColumn
    pixel: IntColumn
    start_s: FloatColumn
    width_s: FloatColumn
    power_w: FloatColumn
    trimmed_j: FloatColumn
    reason: TextColumn


class PulsesEvent(JsonModel):
    """Pulses planned within the next second and pulses executed, since the previous event."""

    board_s: float
    planned: list[PulseBatch]
    executed: list[PulseBatch]


class CapUsage(JsonModel):
    """How much of a cap is used, and the pixel nearest to it. `fraction` is relative to ambient for temperatures."""

    cap: str
    fraction: float
    value: float
    limit: float
    unit: str
    pixel: int | None


class BudgetEvent(JsonModel):
    """The usage of every cap at a board time, and the highest temperature that the panel may have."""

    board_s: float
    caps: list[CapUsage]
    panel_c: float


EVENTS: Mapping[str, type[JsonModel]] = {
    "state": StateReport,
    "display": DisplayEvent,
    "pulses": PulsesEvent,
    "budget": BudgetEvent,
    "fault": FaultEvent,
}
"""Every event by its name."""
