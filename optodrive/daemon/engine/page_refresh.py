"""The part of a standing page that is drawn next, from the places of fingers and the pulses of the stream so far."""

import threading
from collections.abc import Callable, Sequence
from math import ceil, inf
from typing import Literal

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.finger_tracks import FingerTracks, PredictedFinger
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.fingers import FingerPlace
from optodrive.core.types.stimuli import FrameSequence
from optodrive.daemon.engine.planning_snapshot import PlanningSnapshot
from optodrive.device.config import PixelLayout
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.sequence_checks import check_targets_reachable, remove_dead_pixels
from optodrive.planning.stimuli.standing_page import SLOT_S, Refresh, build_refresh, select_bursts

TRACKER_LOST_S = 0.1
"""Without the places of fingers for this time, the page is drawn as if there were none."""
PAGE_GONE_S = 0.5
"""A page that was not refreshed for this time no longer stands."""
AHEAD_SLOTS = 2
"""A dot is drawn for a finger that will touch it within this number of slots."""
MOVE_S = 4e-4
"""Typical time of a move between two pixels under the same finger."""
FIRST_WIDTH_S = 4e-3
MARGIN_S = 0.07
"""Light that is planned beyond the lead of the stream: the next refresh comes meanwhile, and finds some unsent."""


class PageRefresh:
    """Selection of the pixels that a standing page needs next.

    layout: of the pixels; clock: of the host; board_s, lead_s: return the board's time and the lead of streams
    """

    def __init__(
        self, layout: PixelLayout, clock: Clock, board_s: Callable[[], float], lead_s: Callable[[], float]
    ) -> None:
        self._layout, self._clock, self._board_s, self._lead_s = layout, clock, board_s, lead_s
        self._tracks = FingerTracks()
        self._seen_s = -inf
        self._lock = threading.Lock()
        self._width_s = FIRST_WIDTH_S
        self._page_m, self._selected_s = np.zeros(len(layout)), -inf

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
        stands = self._clock.now_s() - self._selected_s <= PAGE_GONE_S
        return self._page_m if stands else np.zeros(len(self._layout))

    def select(self, display: DisplayModel, page: FrameSequence, snapshot: PlanningSnapshot) -> Refresh:
        """Return the part of a page whose turn it is. Raise InputError for a height out of reach."""
        (frame,) = remove_dead_pixels(display, page)[0].frames
        check_targets_reachable(display, page)
        self._page_m, self._selected_s = frame.target_m, self._clock.now_s()
        if snapshot.predecessor is not None:
            self._width_s = float(snapshot.predecessor.planned.plan.width_s.mean())
        pixel_time_s = self._width_s + MOVE_S
        begin_s = self._clock.now_s() + snapshot.start_s - self._board_s()
        slots = ceil((self._lead_s() + MARGIN_S) / SLOT_S)
        touched = np.array([self._find_touched(begin_s + step * SLOT_S) for step in range(slots + AHEAD_SLOTS)])
        is_touched = np.array([touched[slot : slot + AHEAD_SLOTS + 1].any(axis=0) for slot in range(slots)])
        drawn_s = self._find_drawn_s(snapshot)
        bursts = select_bursts(frame.target_m, is_touched, drawn_s, snapshot.start_s, pixel_time_s)
        return build_refresh(frame, bursts, self._layout, pixel_time_s)

    def _find_drawn_s(self, snapshot: PlanningSnapshot) -> FloatArray:
        return np.full(len(self._layout), -inf) if snapshot.cycle is None else snapshot.cycle.drawn_s

    def _find_touched(self, at_s: float) -> BoolArray:
        """Return the pixels under fingers at a time of the host's clock, [p]."""
        touched = np.zeros(len(self._layout), dtype=np.bool_)
        for finger in self.find_fingers(at_s):
            distance_m = np.hypot(self._layout.x_m - finger.x_m, self._layout.y_m - finger.y_m)
            touched |= distance_m <= finger.radius_m + finger.margin_m
        return touched
