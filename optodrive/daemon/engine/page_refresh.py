"""The part of a standing page that is drawn next, from the places of fingers and the pulses of the stream so far."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from math import ceil, inf
from typing import Literal

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.finger_tracks import FingerTracks, PredictedFinger
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.fingers import FingerPlace
from optodrive.core.types.stimuli import FrameSequence
from optodrive.daemon.engine.active_plan import RefreshCycle
from optodrive.daemon.engine.plan_making import PlanningSnapshot
from optodrive.device.config import PixelLayout
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.scheduler.visiting_path import compute_visiting_order
from optodrive.planning.sequence_checks import check_targets_reachable, remove_dead_pixels
from optodrive.planning.stimuli.standing_page import SLOT_S, Refresh, build_refresh, select_bursts

TRACKER_LOST_S = 0.1
"""Without the places of fingers for this time, the page is drawn as if there were none."""
PAGE_TIMEOUT_S = 0.5
"""A page that was not refreshed for this time no longer stands."""
CAP_GONE_S = 1.0
"""A cap limits a page for this time after it took light from a refresh."""
LOOKAHEAD_SLOTS = 3
"""A dot is drawn for a finger that will touch it within this number of slots."""
MARGIN_SHARE = 1.0 / 3.0
"""Share of the margin of a finger's place within which dots have the priority of the dots under it.

Three times as many dots lie within the whole margin as under the finger, more than the beam can refresh.
"""
MOVE_S = 4e-4
"""Typical time of a move between two pixels under the same finger."""
FIRST_WIDTH_S = 4e-3
"""Assumed width of a page's pulses before the first one."""
MARGIN_MIN_S, MARGIN_MAX_S = 0.04, 0.07
"""Light that is planned beyond the lead of the stream: the next refresh comes meanwhile, and finds some unsent."""
MARGIN_INTERVALS, INTERVALS_KEPT = 2.0, 8
"""The same in intervals between refreshes, the longest of the latest ones."""


class PageRefresh:
    """Selection of the pixels that a standing page needs next.

    layout: of the pixels; clock: of the host; board_s, lead_s: return the board's time and the lead of streams
    touched_only: whether the page that stands leaves dots dark that no finger touches
    """

    def __init__(
        self, layout: PixelLayout, clock: Clock, board_s: Callable[[], float], lead_s: Callable[[], float]
    ) -> None:
        self._layout, self._clock, self._board_s, self._lead_s = layout, clock, board_s, lead_s
        self._tracks = FingerTracks()
        self._seen_s = -inf
        self._lock = threading.Lock()
        self._page_m, self._selected_s = np.zeros(len(layout)), -inf
        self.touched_only = False
        self._tour = np.zeros(0, dtype=np.int64)
        self._intervals_s = deque([inf], INTERVALS_KEPT)
        self._limited_s: dict[str, float] = {}

    def update_fingers(self, at_s: float, places: Sequence[FingerPlace]) -> None:
        """Take the places of all fingers at a time of the host's clock."""
        with self._lock:
            self._seen_s = at_s
            self._tracks.update(at_s, places)

    def find_fingers(self, at_s: float) -> tuple[PredictedFinger, ...]:
        """Return where the fingers are at a time of the host's clock. None are known when the tracker is lost."""
        if self.tracker != "seen":
            return ()
        with self._lock:
            return self._tracks.predict(at_s)

    @property
    def tracker(self) -> Literal["none", "seen", "lost"]:
        """Whether the tracker reports, has ceased to, or never did."""
        with self._lock:
            if self._seen_s == -inf:
                return "none"
            return "lost" if self._clock.now_s() - self._seen_s > TRACKER_LOST_S else "seen"

    @property
    def page_m(self) -> FloatArray:
        """Heights of the page that stands, [p], m, 0 without one."""
        stands = self._clock.now_s() - self._selected_s <= PAGE_TIMEOUT_S
        return self._page_m if stands else np.zeros(len(self._layout))

    def note_limits(self, caps: Iterable[str]) -> None:
        """Note the caps that took light from a refresh."""
        self._limited_s = self._limited_s | dict.fromkeys(caps, self._clock.now_s())

    @property
    def limited_by(self) -> tuple[str, ...]:
        """Caps that took light from the page that stands in the last second, in the order of their names."""
        now_s = self._clock.now_s()
        stands = now_s - self._selected_s <= PAGE_TIMEOUT_S
        return tuple(sorted(cap for cap, at_s in self._limited_s.items() if stands and now_s - at_s <= CAP_GONE_S))

    def select(
        self, display: DisplayModel, page: FrameSequence, snapshot: PlanningSnapshot, touched_only: bool = False
    ) -> Refresh:
        """Return the part of a page whose turn it is. Raise InputError for a height out of reach.

        touched_only: leave dots dark that no finger touches
        """
        (frame,) = remove_dead_pixels(display, page)[0].frames
        check_targets_reachable(display, page)
        now_s = self._clock.now_s()
        self._intervals_s.append(now_s - self._selected_s)
        if not np.array_equal(frame.target_m > 0.0, self._page_m > 0.0):
            self._tour = self._compute_tour(frame.target_m)
        self._page_m, self._selected_s, self.touched_only = frame.target_m, now_s, touched_only
        pixel_time_s = _find_width_s(frame.target_m, snapshot.cycle) + MOVE_S
        begin_s = now_s + snapshot.start_s - self._board_s()
        margin_s = min(MARGIN_MAX_S, max(MARGIN_MIN_S, MARGIN_INTERVALS * max(self._intervals_s)))
        slots = ceil((self._lead_s() + margin_s) / SLOT_S)
        touched = self._find_touched((begin_s + SLOT_S * np.arange(slots + LOOKAHEAD_SLOTS)).tolist())
        is_touched = np.logical_or.reduce([touched[step : slots + step] for step in range(LOOKAHEAD_SLOTS + 1)])
        drawn_s = self._find_drawn_s(snapshot)
        bursts = select_bursts(self._tour, is_touched, drawn_s, snapshot.start_s, pixel_time_s, touched_only)
        return build_refresh(frame, bursts, pixel_time_s)

    def _compute_tour(self, page_m: FloatArray) -> IntArray:
        """Return the pixels of a page in their visiting order."""
        layout = self._layout
        return compute_visiting_order(np.flatnonzero(page_m > 0.0), layout.row, layout.column, layout.x_m, layout.y_m)

    def _find_drawn_s(self, snapshot: PlanningSnapshot) -> FloatArray:
        return np.full(len(self._layout), -inf) if snapshot.cycle is None else snapshot.cycle.drawn_s

    def _find_touched(self, times_s: Sequence[float]) -> BoolArray:
        """Return the pixels under fingers at times of the host's clock, [t, p]."""
        if self.tracker != "seen":
            return np.zeros((len(times_s), len(self._layout)), dtype=np.bool_)
        with self._lock:
            predicted = [self._tracks.predict(at_s) for at_s in times_s]
        fingers = np.array(predicted, dtype=np.float64).reshape(len(times_s), -1, len(PredictedFinger._fields))
        _, x_m, y_m, radius_m, margin_m = np.moveaxis(fingers, -1, 0)[..., np.newaxis]
        distance_m2 = (self._layout.x_m - x_m) ** 2 + (self._layout.y_m - y_m) ** 2
        is_under: BoolArray = (distance_m2 <= (radius_m + MARGIN_SHARE * margin_m) ** 2).any(axis=1)
        return is_under


def _find_width_s(page_m: FloatArray, cycle: RefreshCycle | None) -> float:
    """Return the mean width of the last pulses of a page's pixels, s."""
    if cycle is None:
        return FIRST_WIDTH_S
    widths_s = cycle.width_s[page_m > 0.0]
    known_s = widths_s[np.isfinite(widths_s)]
    return float(known_s.mean()) if len(known_s) else FIRST_WIDTH_S
