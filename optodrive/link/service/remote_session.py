"""The planner's session with the boards that the link process owns: its jobs, the points of each, and its commands.

Names follow `BoardSession`.
"""

import zlib
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.ipc import Message
from optodrive.link.protocol.messages import Executed
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.stage_points import DAMAGED_POINTS, StagePoints
from optodrive.link.service.link_connection import LinkConnection, ResultHandler, ignore_result
from optodrive.link.service.point_handover import PointsOrder
from optodrive.link.service.status import LinkStatus, ServiceStatus
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.staged_job import StagedJob

EXECUTED_RECORD = np.dtype([("on_tick", "<u8"), ("on_ticks", "<u4"), ("duty", "<u2")])
"""Record of an executed point in a message of kind `executed`."""


class RemoteJob(StagedJob):
    """Points of one plan in the link process, updated from its messages. Indices are the boards' once it has begun.

    number: by which planner and link process call it; start_ticks: at which the points of each stage begin
    send_delay: sends a shift of the zero, given number and ticks
    """

    def __init__(
        self,
        number: int,
        points: StagePoints,
        zero_tick: int,
        send_delay: Callable[[int, int], None],
        start_ticks: Sequence[int] | None = None,
    ) -> None:
        starts = [zero_tick] * len(points.stages) if start_ticks is None else start_ticks
        pairs = zip(points.stages, starts, strict=True)
        super().__init__([PlanJob(number, one, 0, start_tick) for one, start_tick in pairs], zero_tick)
        self.number = number
        self._send_delay = send_delay
        self._first_sent_tick: float | None = None

    @property
    def first_sent_tick(self) -> float | None:
        """Tick of board_s() at which the first point of all was sent, None before."""
        return self._first_sent_tick

    def update(self, first_index: Sequence[int], sent_points: Sequence[int], first_sent_tick: float | None) -> None:
        """Take over the progress that the link process reports."""
        self._first_sent_tick = first_sent_tick
        for part, first, sent in zip(self.parts, first_index, sent_points, strict=True):
            part.first_index, part.next_to_send = first, first + sent

    def delay(self, ticks: int) -> None:
        """Shift the plan's zero, here and in the link process."""
        super().delay(ticks)
        self._send_delay(self.number, ticks)

    def record_reports(self, stage: int, first_point: int, payload: bytes) -> None:
        """Record the reports of a stage's board. first_point: position in this job of the first reported point."""
        records = tuple(np.frombuffer(payload, EXECUTED_RECORD).tolist())
        part = self.parts[stage]
        part.record_executed(Executed(part.first_index + first_point, records))


REPLY_TIMEOUT_S = 0.6
"""Longest wait for the link process: longer than a stall of a busy computer, which is for the lease to judge, and
shorter than the age of a beat at which the link process counts its caller as stalled."""
BEAT_INTERVAL_S = 0.1


class RemoteSession(LinkStatus):
    """Session of the planner, whose loop calls `connect_if_due`, `beat`, and `receive` of its connection.

    scales: of the board of each stage; path: of the link process's socket
    """

    def __init__(self, scales: Sequence[WireScale], path: Path, clock: Clock) -> None:
        super().__init__(clock)
        self.scales = tuple(scales)
        self.tick_s = scales[0].tick_s
        self.connection = LinkConnection(path, "planner", clock)
        self.connection.on_message, self.connection.on_lost = self._on_message, self._on_lost
        self._beaten_s = -inf
        self._commands_sent = self._drained_number = self._job_number = 0
        self._drained: tuple[float, str] | None = None
        self._refusal: str | None = None
        self._jobs: dict[int, RemoteJob] = {}

    def connect_if_due(self) -> None:
        """Connect to the link process if there is no connection and an attempt is due."""
        if self.connection.connect_if_due():
            self._commands_sent = self.commands = 0
            self._beaten_s = -inf  # the board cannot be armed before the first beat

    # --- messages of the link process -------------------------------------------------------------------------------

    def _on_lost(self) -> None:
        self._take_end(self.connection.end_reason)
        self._jobs.clear()

    def _on_message(self, message: Message) -> None:
        fields = message.fields
        if message.kind == "status":
            status = ServiceStatus.from_fields(fields)
            if status.epoch != self.epoch:
                # Another epoch: link has forgotten all jobs, and none of their reports will come.
                self._jobs.clear()
                self._drained_number, self._drained = status.pause.number, None
            self._take_status(status)
        elif message.kind == "executed":
            job = self._jobs.get(fields["job"])
            if job is not None:
                job.record_reports(fields["stage"], fields["first_point"], message.payload)
        elif message.kind == "progress":
            self._on_progress(fields)
        elif message.kind == "job_refused":
            self._jobs.pop(fields["job"], None)
            if not fields["paused"]:  # else the planner hands the plan over again, see pop_drained()
                self._keep_refusal(fields["reason"])
        elif message.kind == "drained":
            self._on_drained(fields["pause"], fields["board_s"], fields["reason"])
        elif message.kind == "refusal":
            self._keep_refusal(fields["reason"])

    def _keep_refusal(self, reason: str) -> None:
        if self._refusal is None:  # the first refusal causes the following ones
            self._refusal = reason

    def _on_progress(self, fields: dict[str, Any]) -> None:
        job = self._jobs.get(fields["job"])
        if job is None:
            return
        job.update(fields["first_index"], fields["sent_points"], fields["first_sent_tick"])
        if fields["finished"]:
            del self._jobs[fields["job"]]

    def _on_drained(self, number: int, board_s: float, reason: str) -> None:
        self._jobs.clear()
        # The latest only: points carry it, and link refuses those that know an older pause.
        self._drained_number = number
        if self._drained is None:
            self._drained = board_s, reason

    # --- state ------------------------------------------------------------------------------------------------------

    @property
    def is_ready(self) -> bool:
        """Whether a job may start now. False until the link process has carried out all commands sent."""
        # A status from before the last command may still say ready.
        all_seen = self.commands == self._commands_sent
        return self.connected and self.is_startable and all_seen and not self.is_held

    @property
    def is_held(self) -> bool:
        """Whether the light is paused, or reports of pulses emitted before a pause may still arrive."""
        return self.pause_ends_in_s is not None or self._drained_number != self.pause.number

    @property
    def is_interrupted(self) -> bool:
        """Whether the light is held only until all is reported that was executed."""
        return self.is_held and self.pause_ends_in_s is None

    def pop_drained(self) -> tuple[float, str] | None:
        """Return and clear when a pause began, board time, s, and why, once all is reported that was executed by then.

        The reason is '' of a requested pause. The link process has dropped all jobs; it refuses points that were handed
        over before.
        """
        drained, self._drained = self._drained, None
        return drained

    def pop_refusal(self) -> str | None:
        """Return and clear the reason for which link process or board refused a command."""
        refusal, self._refusal = self._refusal, None
        return refusal

    # --- commands -----------------------------------------------------------------------------------------------

    def begin(
        self, points: StagePoints, start_s: float, epoch: int, send_ahead_s: float = inf, crc: int | None = None
    ) -> RemoteJob:
        """Start to stream a plan whose zero is board time start_s. A refusal arrives later, see pop_refusal().

        epoch: in which the request was accepted; send_ahead_s: maximum time from sending a point to its start
        crc: CRC-32 of the bytes that were verified, computed from the points if None
        """
        payload = points.encode_payload()
        self._job_number += 1
        job = RemoteJob(self._job_number, points, max(1, round(start_s / self.tick_s)), self._send_delay)
        self._jobs[job.number] = job
        order = self._build_order(job.number, epoch, points, zlib.crc32(payload) if crc is None else crc, send_ahead_s)
        if not self._send_command("begin", {**order._asdict(), "start_s": start_s}, payload):
            self._keep_refusal(self.link_error or "")
        return job

    def splice(
        self,
        points: StagePoints,
        kept_points: Sequence[int],
        zero_s: float,
        epoch: int,
        send_ahead_s: float,
        crc: int | None = None,
        holds_first: bool = False,
    ) -> RemoteJob | None:
        """Truncate the last job to `kept_points` points of each stage and continue with `points` without a pause.

        holds_first: whether the new points may be withdrawn until the first one is due to be sent
        zero_s: time of board_s() of the new plan's zero; on one board it is where the kept points end
        Return None if it is too late for that, if the epoch has passed, or if the link process does not answer.
        """
        last = self._find_last_job()
        if last is None:
            return None
        start_ticks = [part.end_tick_after(kept) for part, kept in zip(last.parts, kept_points, strict=True)]
        zero_tick = round(zero_s / self.tick_s)
        if len(self.scales) > 1:
            if crc is not None and crc != zlib.crc32(points.encode_payload()):
                self._keep_refusal(DAMAGED_POINTS)
                return None
            # The verified bytes change by these pauses, so they are checked here, and the sum is formed anew.
            points, crc = points.add_pauses([zero_tick - tick for tick in start_ticks]), None
        payload = points.encode_payload()
        self._job_number += 1
        number = self._job_number
        order = self._build_order(number, epoch, points, zlib.crc32(payload) if crc is None else crc, send_ahead_s)
        fields = {**order._asdict(), "kept_points": list(kept_points), "holds_first": holds_first}
        added: list[RemoteJob] = []

        def add_job(result: dict[str, Any]) -> None:
            if result["start_tick"] is not None:
                # Within the result's handler: reports of the truncated job may follow in the same read.
                last.truncate(kept_points)
                if len(self.scales) > 1:
                    job = RemoteJob(number, points, zero_tick, self._send_delay, start_ticks)
                else:
                    job = RemoteJob(number, points, result["start_tick"], self._send_delay)
                job.update(result["first_index"], [0] * len(job.parts), None)
                self._jobs[number] = job
                added.append(job)  # a job without points may be finished, and forgotten, before the next line is read

        self._request("splice", fields, payload, add_job)
        return added[0] if added and self.connection.is_open else None

    def extend(self, job: StagedJob, points: StagePoints, epoch: int, crc: int) -> bool:
        """Append points to the last job without a pause. Arguments and result as for `begin` and `truncate`."""
        last = self._find_last_job()
        # A newer frame has replaced the plan: its rest is of no use any more.
        if last is None or last is not job:
            return False
        order = self._build_order(last.number, epoch, points, crc)

        def extend(result: dict[str, Any]) -> None:
            if result["done"]:
                last.extend(points)

        result = self._request("extend", order._asdict(), points.encode_payload(), extend)
        return result is not None and bool(result["done"])

    def _build_order(
        self, number: int, epoch: int, points: StagePoints, crc: int, send_ahead_s: float = inf
    ) -> PointsOrder:
        # JSON has no infinity: no bound is null.
        ahead_s = None if send_ahead_s == inf else send_ahead_s
        return PointsOrder(number, epoch, self._drained_number, points.counts, crc, ahead_s)

    def truncate(self, kept_points: Sequence[int]) -> bool:
        """Truncate the last job to `kept_points` points of each stage. Return False, unchanged, if more were sent."""
        last = self._find_last_job()
        if last is None:
            return False
        result = self._request("truncate", {"kept_points": list(kept_points)})
        return result is not None and result["done"] and last.truncate(kept_points)

    def flush(self) -> None:
        """Turn the gate off and drop the queue. The board stays armed."""
        self._jobs.clear()
        self._send_command("flush", {})

    def beat(self, alive: bool) -> None:
        """Prove that the loop runs, at most once per interval. alive: whether planning is idle or makes progress."""
        now_s = self._clock.now_s()
        if now_s - self._beaten_s >= BEAT_INTERVAL_S:
            self._beaten_s = now_s
            self.connection.send(Message("beat", {"alive": alive}))

    def _send_delay(self, number: int, ticks: int) -> None:
        self._send_command("delay", {"job": number, "ticks": ticks})

    def _send_command(self, kind: str, fields: dict[str, Any], payload: bytes = b"") -> bool:
        self._commands_sent += 1
        return self.connection.send(Message(kind, fields, payload))

    def _request(
        self, kind: str, fields: dict[str, Any], payload: bytes = b"", on_result: ResultHandler = ignore_result
    ) -> dict[str, Any] | None:
        self._commands_sent += 1
        return self.connection.request(kind, fields, REPLY_TIMEOUT_S, payload, on_result)

    def _find_last_job(self) -> RemoteJob | None:
        return next(reversed(self._jobs.values()), None)
