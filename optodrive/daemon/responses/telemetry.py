"""The events of GET /v1/telemetry, except `state`, which is a StateReport."""

from collections.abc import Mapping
from typing import Literal

from optodrive.core.json_model import FloatColumn, IntColumn, JsonModel, TextColumn
from optodrive.daemon.responses.state import StateReport


class FaultEvent(JsonModel):
    """A fault of the board or the link. All members except the states are null or empty without one.

    board: state of the board
    link: state of the link
    fault: code of the board's fault, null without one
    hint: what it is and how it is removed
    link_error: why the link is down
    """

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
    board_s: time of the board, s
    warm: whether a pixel is warmer or higher than cold
    """

    board_s: float
    warm: bool
    height: str
    height_peak: str
    absorber: str
    absorber_peak: str


class PulseBatch(JsonModel):
    """Pulses of one plan by column. `row` counts in the plan, and `start_s` is board time.

    plan: id of the plan
    name: of its pattern, or push
    row: index of each pulse in the plan
    pixel: of each pulse
    start_s, width_s: board time at which the gate opens, and for how long, s
    power_w: power at the sample, W
    trimmed_j: energy that the limiter removed, J
    reason: caps that removed it, empty without one
    """

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
    """Pulses planned within the next second and pulses executed, since the previous event.

    board_s: time of the board, s
    planned: pulses that begin within the next second, by plan
    executed: pulses that the board has reported, by plan
    """

    board_s: float
    planned: list[PulseBatch]
    executed: list[PulseBatch]


class CapUsage(JsonModel):
    """How much of a cap is used, and the pixel nearest to it. `fraction` is relative to ambient for temperatures.

    cap: name of the cap
    fraction: share of the cap that is used
    value, limit: the quantity and its cap, in `unit`
    unit: of the value and of the cap
    pixel: nearest to the cap, null for a cap of the whole display
    """

    cap: str
    fraction: float
    value: float
    limit: float
    unit: str
    pixel: int | None


class BudgetEvent(JsonModel):
    """The usage of every cap at a board time, and the highest temperature that the panel may have.

    board_s: time of the board, s
    caps: usage of each cap
    panel_c: highest temperature that the panel may have, °C
    """

    board_s: float
    caps: list[CapUsage]
    panel_c: float


class TouchedFinger(JsonModel):
    """A fingertip, with rate and height of the dots of the standing page under it, null without such dots.

    dots: of the page, under the contact
    rate_hz: mean number of pulses of a dot in the last 0.2 s, per second
    height_share: mean height of their newest pulses relative to the page's, at most 1; a dot without one counts as 0
    number: of the fingertip, the same as long as it is tracked
    x_m, y_m, radius_m: centre and radius of its contact, m
    """

    number: int
    x_m: float
    y_m: float
    radius_m: float
    dots: int
    rate_hz: float | None
    height_share: float | None


class FingersEvent(JsonModel):
    """Fingertips at a board time.

    tracker: seen, lost (silent for 0.1 s) or none, which has not reported since the daemon started
    board_s: time of the board, s
    fingers: those that the tracker sees
    """

    board_s: float
    tracker: Literal["none", "seen", "lost"]
    fingers: list[TouchedFinger]


class PageEvent(JsonModel):
    """Heights of the standing page as base64 of little-endian u16 in 0.1 µm, empty without a page.

    limited_by: caps that took light from it in the last second
    touched_only: whether dots are dark that no finger touches
    board_s: time of the board, s
    height: of each pixel, base64 of u16 in 0.1 µm
    """

    board_s: float
    height: str
    limited_by: list[str]
    touched_only: bool


EVENTS: Mapping[str, type[JsonModel]] = {
    "state": StateReport,
    "display": DisplayEvent,
    "pulses": PulsesEvent,
    "budget": BudgetEvent,
    "fingers": FingersEvent,
    "page": PageEvent,
    "fault": FaultEvent,
}
"""Every event by its name."""
