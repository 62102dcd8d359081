"""Streamed frames that stand: the newest one is refreshed until the next, first where fingers are.

Each refresh is a streamed plan of the pixels whose turn it is, which the planner process selects. One is made whenever
new places of fingers have arrived, but not sooner than REFRESH_MIN_S after the last one began, and else every
REFRESH_MAX_S, before the light that is planned ends. A refresh that is refused, as after STOP, ends the frame: it does
not come back by itself. One that found too many requests waiting is tried again.
"""

import asyncio
import time
from math import inf
from typing import Any

from optodrive.core.errors import BusyError
from optodrive.daemon.api.live_stream import Frame, LiveStream, report_planned
from optodrive.daemon.push import Push
from optodrive.daemon.responses.messages import FrameResult, RefreshReport
from optodrive.daemon.responses.plan import PlanReport, PlanStatus
from optodrive.daemon.responses.problem import Problem

REFRESH_MIN_S, REFRESH_MAX_S = 0.008, 0.04
CAPS_PERIOD_S = 1.0
"""Time over which the caps are collected that took light from the frame. Its client is told when they are others."""
TRIED_AGAIN = (BusyError.code,)
"""Codes of the problems after which a frame still stands."""


class StandingStream(LiveStream):
    """Stream of one client whose newest frame stands."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._shown: Frame | None = None
        self._began_s = -inf
        self._fingers_arrived_s: float | None = None
        self._caps: set[str] = set()
        self._published_caps: set[str] = set()
        self._caps_since_s = -inf
        self._fingers_moved = asyncio.Event()

    async def run(self) -> None:
        """Serve until the client disconnects. Then the frame ends."""
        self._daemon.fingers_callbacks.add(self._on_fingers)
        try:
            await super().run()
        finally:
            self._daemon.fingers_callbacks.discard(self._on_fingers)

    def _on_fingers(self, arrived_s: float) -> None:
        if self._fingers_arrived_s is None:
            self._fingers_arrived_s = arrived_s
        self._fingers_moved.set()

    def _may_emit(self) -> bool:
        return self._shown is not None

    async def _take_frame(self) -> Frame:
        """Wait for a frame, or for the time to refresh the one that stands."""
        if self._shown is not None:
            await _wait_for_any(self._began_s + REFRESH_MIN_S, self._arrived)
            await _wait_for_any(self._began_s + REFRESH_MAX_S, self._arrived, self._fingers_moved)
            if not self._arrived.is_set():
                return self._shown
        return await super()._take_frame()

    def _build_push(self, frame: Frame) -> Push:
        """Build the push of a refresh, whose latency counts from the arrival of the first fingers that it follows."""
        self._began_s = time.monotonic()
        push = super()._build_push(frame)._replace(standing=True)
        arrived_s, self._fingers_arrived_s = self._fingers_arrived_s, None
        self._fingers_moved.clear()
        if frame is not self._shown:
            return push
        return push._replace(refreshes=True, arrived_s=self._began_s if arrived_s is None else arrived_s)

    def _follow(self, frame: Frame, report_json: bytes) -> None:
        if frame is self._shown:
            self._publish_caps(frame, RefreshReport.model_validate_json(report_json).limited_by)
            return
        if self._shown is not None:
            superseded = FrameResult(frame=self._shown.number, status=PlanStatus.SUPERSEDED, superseded_by=frame.number)
            self._publish(superseded)
        self._shown, self._last_epoch = frame, frame.epoch
        planned = report_planned(frame.number, PlanReport.model_validate_json(report_json))
        self._published_caps, self._caps, self._caps_since_s = set(planned.limited_by or ()), set(), time.monotonic()
        self._publish(planned)

    def _publish_caps(self, frame: Frame, limited_by: list[str]) -> None:
        """Collect the caps that took light from refreshes, and publish them when they are others than before."""
        self._caps.update(limited_by)
        if time.monotonic() < self._caps_since_s + CAPS_PERIOD_S:
            return
        if self._caps != self._published_caps:
            self._publish(FrameResult(frame=frame.number, status=PlanStatus.PLANNED, limited_by=sorted(self._caps)))
        self._published_caps, self._caps, self._caps_since_s = self._caps, set(), time.monotonic()

    def _refuse(self, frame: Frame, problem: Problem) -> None:
        if frame is self._shown:
            if problem.code in TRIED_AGAIN:
                return
            self._shown = None
        super()._refuse(frame, problem)


async def _wait_for_any(until_s: float, *events: asyncio.Event) -> None:
    """Wait until one of some events is set, but no longer than until a monotonic time."""
    timeout_s = until_s - time.monotonic()
    if timeout_s <= 0.0 or any(event.is_set() for event in events):
        return
    waits = [asyncio.ensure_future(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
