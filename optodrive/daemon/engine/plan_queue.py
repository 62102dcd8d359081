"""What the board is to do: the plans that run and wait, and the heat and budget after them all.

A plan that is streamed leaves little by little, so that a newer one may take the place of what has not left.
"""

import threading
from collections import deque
from concurrent.futures import Executor
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.plans import BudgetState
from optodrive.daemon.engine.plan_record import PlanBook, PlanRecord, Status
from optodrive.daemon.engine.progress import ClockMoved, Progress, Run
from optodrive.daemon.engine.thermal_estimate import Thermal, heated
from optodrive.link.session.fault_hints import hint
from optodrive.link.session.job import Job
from optodrive.link.session.session import Session
from optodrive.link.session.timing_error import TimingTotals, timing_error
from optodrive.physics.thermal_state import Heat
from optodrive.planning.limiter.limiter import fired, shifted
from optodrive.planning.pipeline import Display

START_LEAD_S = 0.05
"""A plan starts so long after it is ready and the one before it has ended: its first points must be there in time."""
STREAM_LEAD_S = 0.02
STREAM_AHEAD_S = 0.04
"""Points of a streamed plan leave so long before they begin; a host that stops for longer makes the board wait."""
DELAY_NOTICED_S = 1e-5
TOLD_MAX = 20_000
"""Where nobody takes away what was done: minutes of it. Notes are references, and cost the loop nothing."""


@dataclass(frozen=True, eq=False)
class Basis:
    """From what a plan is made: its zero on the board's clock, heat and budget then, on its own time line.

    thermal: what was known; a plan made from anything else is of no use
    after: the running plan that it cuts short, before row `cut`; standing_on: the pixel the mirrors stand on then
    seen: [p] pixels that a stream's sweep over the display has lit by then
    """

    thermal: Thermal
    start_s: float
    heat: Heat
    budget: BudgetState
    after: PlanRecord | None = None
    cut: int = 0
    standing_on: int | None = None
    seen: BoolArray | None = None


class _Sweep(NamedTuple):
    """How far a sweep over the display had come when a stream was cut: it goes on if nothing came between."""

    thermal: Thermal
    seen: BoolArray


class Programme:
    """Any thread may ask for `basis`, `busy`, `in_the_way`; all else belongs to the loop that owns the session.

    told: what was done, the newest last, for one reader in another thread who takes it away.
    """

    def __init__(self, display: Display, session: Session, book: PlanBook, bookkeeper: Executor) -> None:
        self.lock = threading.RLock()
        self.running: deque[Run] = deque()
        self.waiting: deque[PlanRecord] = deque()
        self.totals = {"planned": 0, "sent": 0, "executed": 0}
        self.timing = TimingTotals()
        self.told: deque[Progress | ClockMoved] = deque(maxlen=TOLD_MAX)
        self._display = display
        self._session = session
        self._book = book
        self._bookkeeper = bookkeeper
        self._thermal = Thermal(*display.at_rest())
        self._queue_end_s = 0.0
        self._sweep: _Sweep | None = None

    @property
    def busy(self) -> bool:
        """Whether a plan runs or waits."""
        return bool(self.running or self.waiting)

    # --- from what to plan --------------------------------------------------------------------------------------

    def basis(self, streamed: bool, allowance_s: float) -> Basis:
        """Where the next plan begins; a streamed one cuts the running one short, allowance_s for planning from now."""
        with self.lock:
            thermal = self._thermal
            start_s = self._earliest_start_s(streamed, allowance_s if streamed else 0.0)
            last = self._last_streamed() if streamed else None
        if last is not None:
            basis = self._within(last, thermal, self._session.board_s() + STREAM_AHEAD_S + allowance_s)
            if basis is not None:
                return basis
        sweep = self._sweep
        seen = sweep.seen if streamed and sweep is not None and sweep.thermal is thermal else None
        return Basis(thermal, start_s, *thermal.seen_from(start_s), seen=seen)

    def _last_streamed(self) -> PlanRecord | None:
        """The running plan that a newer one may follow without a pause."""
        if self.waiting or not self.running:
            return None
        record = self.running[-1].record
        return record if record.streamed and not record.dropped else None

    def _earliest_start_s(self, streamed: bool, allowance_s: float = 0.0) -> float:
        lead_s = STREAM_LEAD_S if streamed else START_LEAD_S
        return max(self._queue_end_s, self._session.board_s() + allowance_s) + lead_s

    def _within(self, record: PlanRecord, thermal: Thermal, from_s: float) -> Basis | None:
        """What is known where a running plan is cut before its first pulse after from_s; None where none is left."""
        plan = record.prepared.plan
        cut = int(np.searchsorted(plan.start_s, from_s - record.start_s))
        # The mirrors stand on the last pulse's pixel only if that was lit.
        while 0 < cut < len(plan) and plan.power_w[cut - 1] == 0.0:
            cut += 1
        if not 0 < cut < len(plan):
            return None
        end_s = float(plan.start_s[cut - 1] + plan.width_s[cut - 1])
        heat = record.heat_before.copy()
        heat.pulses(plan.pixel[:cut], plan.start_s[:cut], plan.width_s[:cut], plan.power_w[:cut])
        budget = fired(plan, float(plan.start_s[cut]), record.budget_before, self._display.budget)
        return Basis(
            thermal=thermal,
            start_s=record.start_s + end_s,
            heat=heat.shifted(-end_s),
            budget=shifted(budget, -end_s),
            after=record,
            cut=cut,
            standing_on=int(plan.pixel[cut - 1]),
            seen=_seen(record, cut),
        )

    # --- taking plans on ----------------------------------------------------------------------------------------

    def take(self, record: PlanRecord, basis: Basis) -> bool:
        """Take a plan on; False where what it was made from turned out otherwise meanwhile."""
        with self.lock:
            # A plan before this one came late or failed, the board restarted, or too much has left.
            if self._thermal is not basis.thermal:
                return False
            if basis.after is None:
                record.start_s = max(record.start_s, self._earliest_start_s(record.streamed))
                self.waiting.append(record)
            elif not self._follow(record, basis.after, basis.cut):
                return False
            self._thermal = Thermal.after_plan(record.prepared.heat, record.prepared.budget, record.start_s)
            self._queue_end_s = record.start_s + record.prepared.duration_s
            self.totals["planned"] += len(record.prepared.plan)
            record.status = "queued" if basis.after is None else "running"
            record.planned_after_s = self._session.board_s() - record.arrived_s
            self._book.add(record)
            return True

    def _follow(self, record: PlanRecord, before: PlanRecord, cut: int) -> bool:
        if not self.running or self.running[-1].record is not before:
            return False
        job = self._session.follow(record.points, before.points.up_to(cut), STREAM_AHEAD_S)
        if job is None:
            return False
        before.dropped = len(before.prepared.plan) - cut
        self.running.append(Run(record, job))
        return True

    @property
    def in_the_way(self) -> bool:
        """Whether a plan that is newer must first have others give way."""
        with self.lock:
            return bool(self.waiting) or any(not run.record.streamed for run in self.running)

    def make_way(self) -> None:
        """Let what waits, and what runs as a whole, give way to a plan that is newer."""
        with self.lock:
            if self.waiting:
                first = self.waiting[0]
                self._thermal = Thermal.after_plan(first.heat_before, first.budget_before, first.start_s)
                self._queue_end_s = self._thermal.budget.at_s
            while self.waiting:
                self._give_way(self.waiting.popleft())
            if self.running and not self.running[-1].record.streamed:
                record, job = self.running[0]
                record.dropped = len(record.prepared.plan) - job.sent_rows
                self._session.flush()
                self.finish("superseded", "a newer plan took its place")

    def end_soon(self) -> None:
        """Cut the running streamed plan short by itself: what comes next begins anew after it, and need not hurry."""
        with self.lock:
            last = self._last_streamed()
            if last is None:
                return
            basis = self._within(last, self._thermal, self._session.board_s() + STREAM_AHEAD_S)
            if basis is None or not self._session.end_after(last.points.up_to(basis.cut)):
                return
            last.dropped = len(last.prepared.plan) - basis.cut
            self._thermal = Thermal.after_plan(basis.heat, basis.budget, basis.start_s)
            self._queue_end_s = basis.start_s
            self._sweep = _Sweep(self._thermal, _seen(last, basis.cut))

    def _give_way(self, record: PlanRecord) -> None:
        record.dropped = len(record.prepared.plan)
        record.end("superseded", "a newer plan took its place")

    def cancel(self, record: PlanRecord) -> None:
        """Take a plan out of the queue, or end it dark when it runs, with those that follow it at once."""
        if record in self.waiting:
            with self.lock:
                self.waiting.remove(record)
            record.end("cancelled", "taken out of the queue")
        elif any(run.record is record for run in self.running):
            self._session.flush()
            self.finish("cancelled", "ended while it ran")

    # --- running them -------------------------------------------------------------------------------------------

    def start_next(self) -> None:
        """Begin the next plan where the board is ready for it."""
        if self.running or not self.waiting or not self._session.ready:
            return
        with self.lock:
            record = self.waiting.popleft()
            if not len(record.prepared.plan):
                record.end("done", None)
                return
            record.status = "running"
            ahead_s = STREAM_AHEAD_S if record.streamed else inf
            self.running.append(Run(record, self._session.begin(record.points, record.start_s, ahead_s)))

    def follow_jobs(self, refusal: str | None) -> None:
        """Take over what the board did; refusal: what it refused since the last look."""
        board = self._session.board
        if board.state in ("FAULT", "DISARMED", "ARMING", "BOOT") and self.busy:
            cause = self._session.likely_cause if board.fault == "LINK" else None
            likely = hint(board.fault) if cause is None else cause.sentence
            why = f"{board.fault}: {likely}" if board.fault else self._session.last_reason
            self.fail_all(f"the board went to {board.state} ({why})")
        for run in self.running:
            record, job = run
            executed = job.executed_rows
            if executed > record.executed_count:
                self.told.append(Progress(run, record.executed_count, executed))
            self.totals["sent"] += job.sent_rows - record.sent
            self.totals["executed"] += executed - record.executed_count
            record.sent, record.executed_count = job.sent_rows, executed
        while self.running and self.running[0].job.finished:
            self._end_first()
        if self.running and refusal is not None:
            self._session.flush()
            self.finish("failed", f"the board refused a part of it ({refusal})")

    def _end_first(self) -> None:
        """The first running plan is through: a delay moves everything after it."""
        with self.lock:
            record, job = self.running.popleft()
            self._conclude(record, job, "superseded" if record.dropped else "done", None)
            if record.delay_s > DELAY_NOTICED_S:
                self._move_later(record.delay_s)

    def _conclude(self, record: PlanRecord, job: Job, status: Status, error: str | None) -> None:
        scale = self._session.scale
        executed = job.executed(record.prepared.plan, scale.full_power_w, scale.tick_s)
        record.executed = executed
        if record.executed_count < job.pulses:
            self.told.append(Progress(Run(record, job), record.executed_count, job.pulses))
        if job.left_tick is not None:
            record.first_byte_after_s = job.left_tick * scale.tick_s - record.arrived_s
        if len(executed):
            record.first_light_after_s = record.start_s + float(executed.start_s[0]) - record.arrived_s
            record.executed_rows = job.rows_executed()
            last = int(record.executed_rows[-1])
            record.delay_s = float(executed.start_s[-1] - record.prepared.plan.start_s[last])
            record.timing_error = timing_error(record.prepared.plan.start_s[record.executed_rows], executed.start_s)
            if record.timing_error is not None:
                self.timing.add(record.timing_error)
        if status in ("failed", "cancelled"):
            record.end(status, error)
        self._bookkeeper.submit(simulate, record, status, error)

    def _move_later(self, delay_s: float) -> None:
        with self.lock:
            self._thermal = self._thermal.later(delay_s)
            self._queue_end_s += delay_s
            for record in (*(run.record for run in self.running), *self.waiting):
                record.start_s += delay_s
            for run in self.running:
                run.job.later(round(delay_s / self._session.scale.tick_s))

    def finish(self, status: Status, error: str | None) -> None:
        """End everything that runs; what was executed is taken over."""
        with self.lock:
            ended = list(self.running)
            self.running.clear()
            for record, job in ended:
                self._conclude(record, job, status, error)
            delay_s = max((record.delay_s for record, _ in ended), default=0.0)
            if delay_s > DELAY_NOTICED_S:
                self._move_later(delay_s)
            if ended and not self.waiting:
                self._rewind([record for record, _ in ended])

    def _rewind(self, ended: list[PlanRecord]) -> None:
        """Nothing after these will run, nor what they have not fired: heat and budget forget both."""
        dark_s = self._session.board_s() + self._display.config.board.lease_s
        first = ended[0]
        heat, budget, zero_s = first.heat_before, first.budget_before, first.start_s
        for record in ended:
            plan = record.prepared.plan
            heat, budget = heat.shifted(zero_s - record.start_s), shifted(budget, zero_s - record.start_s)
            zero_s = record.start_s
            kept = len(plan) - record.dropped
            if kept:
                until_s = min(dark_s - record.start_s, float(np.nextafter(plan.start_s[kept - 1], inf)))
                budget = fired(plan, until_s, budget, self._display.budget)
            if record.executed is not None:
                heat = heated(heat, record.executed)
        self._thermal = Thermal.after_plan(heat, budget, zero_s)
        self._queue_end_s = max(dark_s, self._thermal.budget.at_s)

    def fail_all(self, why: str) -> None:
        """Nothing that runs or waits will go on."""
        with self.lock:
            waiting = list(self.waiting)
            self.waiting.clear()
            if self.running:
                self.finish("failed", why)
            elif waiting:
                self._rewind(waiting[:1])
        for record in waiting:
            record.end("failed", why)

    def board_restarted(self, delay_s: float) -> None:
        """The board's clock was set anew: what is known of heat moves onto it."""
        self.told.append(ClockMoved(delay_s))
        with self.lock:
            self._thermal = self._thermal.later(delay_s)
            self._queue_end_s = 0.0


def _seen(record: PlanRecord, cut: int) -> BoolArray:
    """What a sweep over the display has lit when a plan of it is cut; a sweep that is through begins anew."""
    pixel = record.prepared.plan.pixel
    seen = np.zeros(len(record.heat_before.pixels), dtype=np.bool_) if record.seen is None else record.seen.copy()
    seen[pixel[:cut]] = True
    return seen if not seen[pixel[cut:]].all() else np.zeros_like(seen)


def simulate(record: PlanRecord, status: Status, error: str | None) -> None:
    """Heights of what was executed; a plan is done only then, so that whoever sees it done may read them."""
    try:
        record.simulated_m = simulated_m(record)
    finally:
        if not record.ended:
            record.end(status, error)


def simulated_m(record: PlanRecord) -> FloatArray | None:
    """Heights of what was executed, [n]; None where nothing was reported."""
    executed = record.executed
    if executed is None:
        return None
    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    return record.heat_before.copy().pulses(*columns).displacement_m
