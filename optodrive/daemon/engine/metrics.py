"""Counts of pulses and plans, and the metrics of GET /metrics in the Prometheus text format, version 0.0.4.

`PulseAccounts` says how many pulses were planned, sent and executed, when, and with which error; events on the progress
of running plans go to one reader in another thread. `build_queue_report` lists the plans for the state.
"""

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from optodrive import __version__
from optodrive.core.histogram import Histogram
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.queue_state import PlanRun, QueueState
from optodrive.daemon.responses.plan import ENDS, PlanStatus
from optodrive.daemon.responses.state import PlannerState, QueuedPlan, QueueReport, RecentPlan
from optodrive.device.config import Config
from optodrive.link.protocol.states import BoardState
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.clock_sync import ClockReading, TimingTotals, compute_timing_error

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
LATENCY_BUCKETS_S = (0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
REPORTED_STATES = tuple(state for state in BoardState if state != BoardState.BOOT)
Labels = Mapping[str, str]


class PlanProgress(NamedTuple):
    """Event: pulses begin to end of a run, in order of its points, were executed or will never be."""

    run: PlanRun
    begin: int
    end: int


class ClockShift(NamedTuple):
    """Event: the board's clock restarted, and earlier events happened delay_s later on it."""

    delay_s: float


def merge_events(events: Iterable[PlanProgress | ClockShift]) -> list[PlanProgress | ClockShift]:
    """Merge consecutive progress events of a run, because the cost of processing is per event."""
    merged: list[PlanProgress | ClockShift] = []
    for event in events:
        last = merged[-1] if merged else None
        if isinstance(event, PlanProgress) and isinstance(last, PlanProgress) and event.run.job is last.run.job:
            merged[-1] = event._replace(begin=last.begin)  # the newer run, whose plan may have grown
        else:
            merged.append(event)
    return merged


EVENTS_MAX = 4000
"""Maximum number of events without a reader, 20 s at least. An event keeps its plan in memory."""


class PulseAccounts:
    """Totals over all plans, and reader of the reports on the running ones.

    Only the loop's thread changes them.
    totals: numbers of pulses planned, sent and executed; timing: largest errors of their times
    events: executed pulses and clock shifts, newest last, for one reader in another thread that removes them
    """

    def __init__(self, session: RemoteSession) -> None:
        self.totals = {"planned": 0, "sent": 0, "executed": 0}
        self.timing = TimingTotals()
        self.events: deque[PlanProgress | ClockShift] = deque(maxlen=EVENTS_MAX)
        self._session = session

    def count(self, before: PlanRecord | None, after: PlanRecord) -> None:
        """Count the pulses that a plan has more than before, None for a new one. Those sent again count again."""
        self.totals["planned"] += after.pulse_count - (0 if before is None else before.pulse_count)
        if before is not None:
            self.totals["sent"] += max(0, after.sent - before.sent)
            self.totals["executed"] += max(0, after.executed_count - before.executed_count)

    def read_progress(self, run: PlanRun) -> PlanRun:
        """Return a run with the numbers of its pulses that were sent and executed, the same one without news."""
        (plan, job), record, before = run, run.plan.record, run.plan.executed_before
        sent, executed = before + job.sent_count, before + job.executed_count
        if (sent, executed) == (record.sent, record.executed_count):
            return run
        if executed > record.executed_count:
            progress = PlanProgress(run, record.executed_count - before, job.executed_count)
            self.events.append(progress)
            if record.onset is None:
                plan = plan.note(onset=self._read_onset(progress))
        return PlanRun(plan.note(sent=sent, executed_count=executed), job)

    def _read_onset(self, progress: PlanProgress) -> ClockReading | None:
        """Convert the time of the first gate on as soon as it is reported: later, the clocks would have drifted."""
        job, clocks = progress.run.job, self._session.read_clocks()
        reported = job.read_reported(progress.begin, progress.end, self._session.scales)
        on_tick = reported.on_tick[reported.on_ticks > 0]
        return clocks.convert(float(on_tick[0]) * self._session.tick_s) if len(on_tick) and clocks else None

    def collect_executed(self, run: PlanRun) -> PlanRun:
        """Return a run with its executed pulses in its plan. The job ends with that, or is interrupted."""
        run = self.read_progress(run)  # reports may have arrived with what ends the job
        plan, job = run
        record, start_s, session = plan.record, plan.planned.plan.start_s, self._session
        if job.executed_count < job.pulse_count:
            self.events.append(PlanProgress(run, job.executed_count, job.pulse_count))
        reported = job.build_executed(plan.planned.plan, session.scales, plan.zero_s)
        plan = plan.add_executed(reported, job.list_executed_rows())
        changes: dict[str, Any] = {}
        if job.first_sent_tick is not None and record.first_byte_after_s is None:
            changes["first_byte_after_s"] = job.first_sent_tick * session.tick_s - record.arrived_s
        executed, rows = plan.executed, plan.executed_rows
        if executed is not None and rows is not None and len(executed):
            light_s = executed.start_s[executed.width_s > 0.0]
            if len(light_s):
                changes["first_light_after_s"] = record.start_s + float(light_s[0]) - record.arrived_s
            if len(session.scales) == 1:  # several boards drop what would come late
                changes["delay_s"] = float(executed.start_s[-1] - start_s[rows[-1]])
            changes["timing_error"] = compute_timing_error(start_s[rows], executed.start_s)
        return PlanRun(plan.note(**changes), job)


class PlanCounters:
    """Counters of ended plans: number by status, streamed frames, and latency from request to first emission."""

    def __init__(self) -> None:
        self.ended: Counter[str] = Counter(dict.fromkeys(ENDS, 0))
        self.first_light = Histogram(LATENCY_BUCKETS_S)
        self.min_headroom_k: float | None = None
        self.frames_shown = self.frames_superseded = 0

    def record_end(self, plan: ActivePlan) -> None:
        """Count an ended plan. The loop's thread and the simulation thread call it, for different plans."""
        record = plan.record
        self.ended[record.status] += 1
        if record.streamed and not record.refreshes:
            is_shown = record.executed_count > 0 or record.status == PlanStatus.DONE
            self.frames_shown += is_shown
            self.frames_superseded += not is_shown and record.status == PlanStatus.SUPERSEDED
        self.min_headroom_k = float(plan.planned.plan.headroom_k.min())
        if record.first_light_after_s is not None:
            self.first_light.add(record.first_light_after_s)


def render_metrics(config: Config, session: RemoteSession, state: PlannerState, counters: PlanCounters) -> str:
    """Render the metrics of link, board and planner. A status of the link process must have arrived."""
    board, link = session.board if session.connected else session.board.forget_state(), session.stats
    page = _MetricsPage()
    page.add_gauge("info", "Version and display", [({"version": __version__, "display": config.name}, 1)])
    page.add_gauge(
        "board_state", "1 for the board's state", [({"state": s}, int(board.state == s)) for s in REPORTED_STATES]
    )
    page.add_counter(
        "board_faults_total", "Number of transitions of the board to each fault", _label_counts("fault", session.faults)
    )
    page.add_counter("laser_on_seconds_total", "Gate-on time × duty since the board's power-up, s", board.laser_on_s)
    page.add_counter("underruns_total", "Number of times the board ran out of points", board.underruns)
    page.add_gauge("board_temperature_celsius", "The board's temperature", board.temperature_c)
    page.add_gauge("link_up", "1 while the link to the board is up", int(session.connected))
    received, sent = {"at": "host"}, {"at": "board"}
    bad = [(received, link["host_bad_frames"]), (sent, link["board_bad_frames"])]
    page.add_counter("link_bad_frames_total", "Damaged frames since the link was opened", bad)
    page.add_counter(
        "link_retransmitted_total", "Frames retransmitted since the link was opened", link["retransmitted"]
    )
    page.add_counter("link_naks_total", "Frames the board refused since the link was opened", link["naks"])
    page.add_gauge(
        "link_round_trip_seconds", "Shortest recent round trip to the board", _ms_to_s(link["round_trip_ms"])
    )
    page.add_gauge("link_longest_stall_seconds", "Longest iteration of the loop", _ms_to_s(link["longest_stall_ms"]))
    pulses = [({"stage": stage}, getattr(state.totals, stage)) for stage in ("planned", "sent", "executed")]
    page.add_counter("pulses_total", "Pulses planned, sent to the board, executed by it", pulses)
    frames = [({"outcome": name}, getattr(state.totals, f"frames_{name}")) for name in ("shown", "superseded")]
    page.add_counter("stream_frames_total", "Planned frames of streams that have ended, by outcome", frames)
    page.add_counter("plans_total", "Ended plans by status", _label_counts("status", counters.ended))
    page.add_gauge("plans_waiting", "Plans waiting for the beam", state.queue.waiting)
    page.add_gauge("planner_alive", "1 while the planner is idle or makes progress", int(state.planner.alive))
    page.add_gauge(
        "plan_headroom_kelvin",
        "Minimum distance of an absorber's bound from its cap, last plan",
        counters.min_headroom_k,
    )
    page.add_histogram("first_light_seconds", "Time from a plan's arrival to its first emission", counters.first_light)
    page.add_histogram("lease_age_seconds", "Age of the lease at its renewal", session.lease_ages)
    page.add_gauge("lease_seconds", "Age of the lease at which the board turns the gate off", config.lease_s)
    page.add_gauge("lease_slack_seconds", "Minimum remaining lease at a renewal", session.lease_slack_s)
    return page.render()


class _MetricsPage:
    def __init__(self) -> None:
        self._lines: list[str] = []

    def add_gauge(self, name: str, help_text: str, value: "float | Iterable[tuple[Labels, float]] | None") -> None:
        """Add a gauge, or nothing if its value is unknown."""
        self._add_family(name, "gauge", help_text, value)

    def add_counter(self, name: str, help_text: str, value: "float | Iterable[tuple[Labels, float]]") -> None:
        """Add a counter."""
        self._add_family(name, "counter", help_text, value)

    def add_histogram(self, name: str, help_text: str, histogram: Histogram) -> None:
        """Add a histogram."""
        self._add_header(name, "histogram", help_text)
        bounds = [*(repr(bound) for bound in histogram.bounds), "+Inf"]
        counts, total = histogram.cumulative_counts(), histogram.sum
        for bound, count in zip(bounds, counts, strict=True):
            self._add_sample(f"{name}_bucket", {"le": bound}, count)
        self._add_sample(f"{name}_sum", {}, total)
        self._add_sample(f"{name}_count", {}, counts[-1])

    def render(self) -> str:
        """Return the text of all metrics."""
        return "\n".join(self._lines) + "\n"

    def _add_family(self, name: str, kind: str, help_text: str, value: Any) -> None:
        if value is None:
            return
        self._add_header(name, kind, help_text)
        for labels, number in [({}, value)] if isinstance(value, int | float) else value:
            self._add_sample(name, labels, number)

    def _add_header(self, name: str, kind: str, help_text: str) -> None:
        self._lines += [f"# HELP optodrive_{name} {help_text}.", f"# TYPE optodrive_{name} {kind}"]

    def _add_sample(self, name: str, labels: Labels, number: float) -> None:
        label_text = ",".join(f'{key}="{_escape_label(text)}"' for key, text in labels.items())
        self._lines.append(f"optodrive_{name}{f'{{{label_text}}}' if label_text else ''} {number!r}")


def _label_counts(label: str, counts: Counter[str]) -> list[tuple[Labels, float]]:
    return [
        ({label: name}, count) for name, count in counts.copy().items()
    ]  # a copy, because another thread may add a name


def _ms_to_s(milliseconds: float | None) -> float | None:
    return None if milliseconds is None else milliseconds * 1e-3


def _escape_label(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')


def build_queue_report(
    state: QueueState, pause_ends_in_s: float | None, recent: list[PlanRecord], board_now_s: float, host_now_s: float
) -> QueueReport:
    """Report the running and waiting plans with their progress at a board and host time, s, and the recent ones."""
    running = [run.plan.record for run in state.running]
    waiting = [plan.record for plan in state.waiting]
    if waiting and waiting[0].status == PlanStatus.PAUSED:
        running.append(waiting.pop(0))
    times_at_s = board_now_s if state.off_s is None else state.off_s  # as if the queue went on now
    return QueueReport(
        waiting=len(waiting),
        running=running[0].plan_id if running else None,
        paused=pause_ends_in_s is not None,
        pause_ends_in_s=pause_ends_in_s,
        active=[_build_queued(record, times_at_s, host_now_s) for record in (*running, *waiting)],
        plans=[RecentPlan.from_object(record, **_name_counts(record, host_now_s)) for record in recent],
    )


def _name_counts(record: PlanRecord, host_now_s: float) -> dict[str, Any]:
    age_s = max(0.0, host_now_s - record.arrived_host_s)
    return {"plan": record.plan_id, "age_s": age_s, "planned": record.pulse_count, "executed": record.executed_count}


def _build_queued(record: PlanRecord, board_now_s: float, host_now_s: float) -> QueuedPlan:
    starts_in_s = record.start_s + record.delay_s - board_now_s
    ends_in_s = None if record.status == PlanStatus.PAUSED else max(0.0, starts_in_s + record.duration_s)
    counts = _name_counts(record, host_now_s)
    return QueuedPlan.from_object(record, **counts, starts_in_s=starts_in_s, ends_in_s=ends_in_s)
