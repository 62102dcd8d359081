"""Producer of the telemetry's display, budget, fingers, page and pulses events as text, from executed reports.

It runs in a thread of its own. Without readers it only follows the executed pulses.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.ipc import Message
from optodrive.core.json_model import JsonModel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.engine.metrics import ClockShift, merge_events
from optodrive.daemon.engine.telemetry_events import (
    EmittedPulses,
    ExecutedBatch,
    LiveThermalState,
    TouchReport,
    build_display_event,
    build_page_event,
    build_pulse_batch,
    describe_caps,
    join_in_order,
)
from optodrive.daemon.responses.telemetry import BudgetEvent, FingersEvent
from optodrive.physics.nominal_display import DisplayState

IDLE_RATE_HZ = 20.0
BUDGET_PERIOD_S, COLD_DISPLAY_PERIOD_S, PAGE_PERIOD_S = 0.25, 1.0, 1.0
DRAIN_PERIOD_S = 1.0
"""Interval between two collections of executed pulses without readers."""
WARM_DISPLACEMENT_M, WARM_RISE_K = 5e-8, 0.1
"""A pixel above either threshold is warm."""
ANNOUNCE_LEAD_S = 1.0
"""Planned pulses are published this long before they start."""
BATCHES_MAX, PULSES_KEPT_MAX = 300, 6000
"""Batches and pulses that are kept for later readers."""
PULSES_MAX = 3000
"""Pulses of one batch; the earlier ones are omitted."""


class TelemetryProducer:
    """Thread that produces events at the highest rate of the readers.

    publish: called in the thread with each message, see `TelemetryHub`; must not block
    on_failure: called in the thread with the error that ends it
    """

    def __init__(
        self,
        engine: Engine,
        clock: Clock,
        publish: Callable[[Message], None],
        on_failure: Callable[[BaseException], None],
    ) -> None:
        self._engine = engine
        self._config = engine.display.config
        self._clock = clock
        self._publish_message = publish
        self._on_failure = on_failure
        self._executed_state = LiveThermalState(engine.display)
        self._touch = TouchReport(engine.display.layout)
        self._tracker, self._page_m = "", np.zeros(0)
        self._limited_by: tuple[str, ...] = ()
        self._touched_only = False
        self._batches: deque[Message] = deque()
        self._batch_number = self._kept_pulses = 0
        self._announced_rows: dict[tuple[str, int], int] = {}
        self._next_s: dict[str, float] = {}
        self._board_clock_reference = (0.0, 0.0)
        self._is_warm = self._has_upcoming = False
        self._readers, self._rate_hz = 0, IDLE_RATE_HZ
        self._is_closing = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._is_closing = True
        self._wake.set()
        self._thread.join(timeout=5.0)

    def set_readers(self, readers: int, rate_hz: float) -> None:
        """Set the number of readers and their highest rate. Any thread may call it."""
        self._readers, self._rate_hz = readers, rate_hz
        self._wake.set()

    def restart(self) -> list[Message]:
        """Return the kept batches for a new consumer, and send it all other events at once. Any thread may call it."""
        self._next_s = {}
        return list(self._batches)

    def _run(self) -> None:
        try:
            self._produce_periodically()
        except BaseException as error:  # of the process: without this thread, pages would show a display of the past
            self._on_failure(error)

    def _produce_periodically(self) -> None:
        next_s = self._clock.now_s()
        while not self._is_closing:
            self._wake.clear()
            self.produce()
            next_s = max(next_s + self._compute_period_s(), self._clock.now_s())
            if self._wake.wait(next_s - self._clock.now_s()):
                next_s = self._clock.now_s()

    def _compute_period_s(self) -> float:
        if not self._readers:
            return DRAIN_PERIOD_S
        is_busy = self._is_warm or self._has_upcoming
        return 1.0 / (self._rate_hz if is_busy else min(self._rate_hz, IDLE_RATE_HZ))

    def produce(self) -> None:
        """Collect the executed and the planned pulses, and publish the events that are due if there are readers."""
        now_s = self._clock.now_s()
        board_s = self._estimate_board_s(now_s)
        self._collect_executed()
        self._announce_planned(board_s)
        if not self._readers:
            self._executed_state.take_peaks()  # they are older than what the next reader has seen
            return
        self._publish_display(now_s, board_s)
        self._publish_touch(now_s, board_s)
        if self._is_due("budget", now_s, BUDGET_PERIOD_S):
            caps = describe_caps(self._executed_state.compute_usage(board_s), self._config.limits)
            panel_c = round(self._executed_state.compute_panel_c(board_s), 3)
            self._publish("budget", BudgetEvent(board_s=board_s, caps=caps, panel_c=panel_c))

    def _estimate_board_s(self, now_s: float) -> float:
        """Estimate the board's time, which is extrapolated while there is no link."""
        if self._engine.is_linked:
            self._board_clock_reference = now_s, self._engine.board_s()
        return self._board_clock_reference[1] + now_s - self._board_clock_reference[0]

    def _is_due(self, kind: str, now_s: float, period_s: float) -> bool:
        due = now_s >= self._next_s.get(kind, now_s)
        if due:
            self._next_s[kind] = now_s + period_s
        return due

    def _publish(self, event: str, model: JsonModel) -> None:
        fields = {"event": event, "warm": self._is_warm, "upcoming": self._has_upcoming}
        self._publish_message(Message("telemetry", fields, model.model_dump_json().encode()))

    def _publish_display(self, now_s: float, board_s: float) -> None:
        pixel_state = self._executed_state.state_at(board_s)
        was_warm = self._is_warm
        peaks = DisplayState(*map(np.maximum, self._executed_state.take_peaks(), pixel_state))
        self._is_warm = bool(
            peaks.displacement_m.max() > WARM_DISPLACEMENT_M or np.abs(pixel_state.absorber_k).max() > WARM_RISE_K
        )
        if self._is_warm or was_warm or self._is_due("display", now_s, COLD_DISPLAY_PERIOD_S):
            event = build_display_event(board_s, self._is_warm, pixel_state, peaks, self._config.ambient_c)
            self._publish("display", event)

    def _publish_touch(self, now_s: float, board_s: float) -> None:
        """Publish fingers while a tracker reports, the page when it changes, and both from time to time."""
        page, tracker = self._engine.page, self._engine.page.tracker
        page_m, limited_by, touched_only = page.page_m, page.limited_by, page.touched_only
        if tracker == "seen" or tracker != self._tracker or self._is_due("fingers", now_s, PAGE_PERIOD_S):
            touched = self._touch.build(board_s, page.find_fingers(now_s), page_m)
            self._publish("fingers", FingersEvent(board_s=round(board_s, 6), tracker=tracker, fingers=touched))
        is_other = not np.array_equal(page_m, self._page_m) or limited_by != self._limited_by
        is_other |= touched_only != self._touched_only
        if is_other or self._is_due("page", now_s, PAGE_PERIOD_S):
            self._publish("page", build_page_event(board_s, page_m, limited_by, touched_only))
        self._tracker, self._page_m, self._limited_by = tracker, page_m, limited_by
        self._touched_only = touched_only

    def _collect_executed(self) -> None:
        waiting: list[EmittedPulses] = []
        for event in merge_events(self._engine.drain_events()):
            if isinstance(event, ClockShift):
                self._apply(waiting)
                self._executed_state.shift_clock(event.delay_s)
                self._touch.clear()
                waiting = []
                continue
            plan, row, pulses = ExecutedBatch.from_progress(event, self._engine.scales)
            if len(row):
                waiting.append(pulses)
                self._add_batch("executed", plan, row, pulses.start_s, pulses.width_s, pulses.power_w)
        self._apply(waiting)

    def _apply(self, batches: Sequence[EmittedPulses]) -> None:
        """Add executed pulses to the display's state, many at once: a call costs more than a hundred pulses."""
        for pulses in join_in_order(batches):
            self._touch.add(pulses.pixel, pulses.start_s, self._executed_state.apply(pulses))

    def _announce_planned(self, board_s: float) -> None:
        """Publish the planned pulses that start soon."""
        upcoming = self._engine.list_upcoming()
        self._has_upcoming = bool(upcoming)
        # Rows after an interruption are others.
        keys = [(active.plan_id, active.first_row) for active in upcoming]
        self._announced_rows = {key: self._announced_rows.get(key, key[1]) for key in keys}
        for key, active in zip(keys, upcoming, strict=True):
            record, plan = active.record, active.planned.plan
            begin = self._announced_rows[key]
            end = int(np.searchsorted(plan.start_s, board_s + ANNOUNCE_LEAD_S - record.start_s))
            if end > begin:
                row = np.arange(begin, end)
                columns = (plan.start_s[begin:end] + record.start_s, plan.width_s[begin:end], plan.power_w[begin:end])
                self._add_batch("planned", active, row, *columns)
                self._announced_rows[key] = end

    def _add_batch(
        self,
        kind: str,
        plan: ActivePlan,
        row: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
    ) -> None:
        newest = slice(-PULSES_MAX, None)
        row = row[newest]
        batch = build_pulse_batch(plan, row, start_s[newest], width_s[newest], power_w[newest])
        self._batch_number += 1
        fields = {
            "number": self._batch_number,
            "batch": kind,
            "count": len(row),
            "board_s": self._board_clock_reference[1],
        }
        message = Message("pulses", fields, batch.model_dump_json().encode())
        self._batches.append(message)
        self._kept_pulses += len(row)
        while self._kept_pulses > PULSES_KEPT_MAX or len(self._batches) > BATCHES_MAX:
            self._kept_pulses -= self._batches.popleft().fields["count"]
        if self._readers:
            self._publish_message(message)
