"""Handover of the planner's points to the session, and the reports of their execution to the planner.

Theory of operation

Problem. The planner computes for milliseconds and may stall, crash or restart; the link process must renew the lease
and carry out STOP meanwhile. So the planner hands over the points of a whole plan at once, under a job number of its
own, and link streams them. Everything that crosses this border may be outdated by the time it arrives.

Invariants. Points reach a board only if four things hold at that moment, in one place (`_require_allowed`): they are of
the present epoch (no STOP, disarm, fault or lost process since the request), they know the last pause (else they could
be lit now and again as a part of the paused plan's rest), the boards are armed, and the checksum over the bytes that
the limiter verified is that of the bytes that arrived. A refusal is an answer with a reason, never silence. Numbers of
jobs are the planner's, indices of points the board's; only this module knows both.

Reports. The planner learns per job how many points have left, when the first one did, and which were executed, at what
times and duties; it needs the latter for heat and budget, so none may be lost or reported twice: a record is forwarded
with its index in the job, adjacent records as one message, at most each `REPORT_INTERVAL_S`, and always before the news
that a job has finished, a flush or the end of a pause. After a pause the planner must know all that was lit before it
plans the rest: `drained` is sent only when the boards have shown that no report is under way (decision 37).

Why binary. A full frame is thousands of points; they travel as the bytes that the board gets, so that the check sum
covers them from the limiter's verification to here. Only the fields around them are JSON.
"""

import struct
import zlib
from collections.abc import Callable, Mapping
from math import inf
from typing import Any, NamedTuple, Self

from optodrive.core.clock import Clock
from optodrive.core.errors import NotReadyError, OptodriveError
from optodrive.core.ipc import Message
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.stage_points import DAMAGED_POINTS, StagePoints
from optodrive.link.protocol.states import ARMED_STATES
from optodrive.link.service.control import Epoch, Pauses
from optodrive.link.service.link_connection import build_result
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.staged_job import StagedJob

EXECUTED = struct.Struct("<QIH")
"""Executed point in a message: tick of gate on, gate-on time in ticks, duty."""
REPORT_INTERVAL_S = 0.01
"""Interval of the reports to the planner, so that it need not process a message per pulse."""


class _ExecutedReport(NamedTuple):
    """Executed points of a job on the board of a stage, from first_point on."""

    number: int
    stage: int
    first_point: int
    records: bytearray

    @property
    def end_point(self) -> int:
        return self.first_point + len(self.records) // EXECUTED.size


class PointsOrder(NamedTuple):
    """Fields that `begin`, `splice` and `extend` share, which say where the points in their payload belong.

    job: the planner's number; epoch: in which the request was accepted; pause: number of the last one that the planner
    knows; counts: number of points of each stage; crc: CRC-32 of the bytes that were verified
    ahead_s: maximum time from sending a point to its start, None without one
    """

    job: int
    epoch: int
    pause: int
    counts: list[int]
    crc: int
    ahead_s: float | None = None

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any]) -> Self:
        """Read the order of a message. Raise LookupError, TypeError or ValueError if it is malformed."""
        numbers = {name: int(fields[name]) for name in ("job", "epoch", "pause", "crc")}
        ahead_s = None if fields["ahead_s"] is None else float(fields["ahead_s"])
        return cls(**numbers, counts=[int(count) for count in fields["counts"]], ahead_s=ahead_s)

    @property
    def send_ahead_s(self) -> float:
        """Maximum time from sending a point to its start, s."""
        return inf if self.ahead_s is None else self.ahead_s


class PointHandover:
    """Jobs of the planner in the present epoch, under the planner's numbers.

    send: sends a message to the planner; commands: number of commands since the planner connected
    """

    def __init__(
        self,
        boards: BoardGroup,
        clock: Clock,
        epoch: Epoch,
        pauses: Pauses,
        send: Callable[[Message], None],
    ) -> None:
        self.commands = 0
        self._boards = boards
        self._clock = clock
        self._epoch = epoch
        self._pauses = pauses
        self._is_draining = False
        self._send = send
        self._jobs: dict[int, StagedJob] = {}
        self._progress: dict[int, tuple[list[int], float | None, bool]] = {}
        self._executed: list[_ExecutedReport] = []
        self._reported_s = -inf
        boards.on_executed = self._forward_executed

    def clear(self) -> None:
        """Report the executed pulses, and forget all jobs."""
        self._send_executed()
        self._jobs.clear()
        self._progress.clear()

    def pause(self) -> None:
        """Turn the gate off and drop the queue. The planner is told when all is reported that was executed."""
        # Jobs stay: their last reports are still to come, and `finish_pause` forgets them.
        self._is_draining = True
        self._boards.drain()

    def finish_pause(self) -> None:
        """Tell the planner, once, that a pause has no more reports."""
        if self._is_draining and not self._boards.is_draining:
            self._is_draining = False
            # Reports first, then `drained`: the planner takes all that was lit as known from then on.
            self._report_jobs()
            self.clear()
            fields = {"pause": self._pauses.number, "board_s": self._pauses.began_s, "reason": self._pauses.reason}
            self._send(Message("drained", fields))

    def carry_out(self, message: Message) -> None:
        """Carry out a command of the planner. Raise KeyError, TypeError or ValueError if it is malformed."""
        self.commands += 1
        {
            "begin": self._begin,
            "splice": self._splice,
            "extend": self._extend,
            "truncate": self._truncate,
            "flush": self._flush,
            "delay": self._delay,
        }[message.kind](message)

    def _begin(self, message: Message) -> None:
        order, points = _parse_points(message)
        start_s = float(message.fields["start_s"])
        try:
            self._require_allowed(order, message.payload)
            # A refusal and no queue: the planner starts a job only when the former has finished, so this one crossed
            # another.
            if self._boards.has_points:
                raise NotReadyError("the board still executes an earlier job")
            job = self._boards.begin(points, start_s, order.send_ahead_s)
        except OptodriveError as error:
            paused = not self._pauses.permits(order.pause)
            self._send(Message("job_refused", {"job": order.job, "reason": str(error), "paused": paused}))
            return
        self._jobs[order.job] = job

    def _splice(self, message: Message) -> None:
        fields, (order, points) = message.fields, _parse_points(message)
        job, error = None, None
        try:
            self._require_allowed(order, message.payload)
            kept = _parse_kept(fields, points)
            job = self._boards.splice(points, kept, order.send_ahead_s, bool(fields["holds_first"]))
        except OptodriveError as refusal:
            error = refusal
        outcome: dict[str, Any] = {"start_tick": None, "first_index": None}
        if job is not None:
            self._jobs[order.job] = job
            outcome = {"start_tick": job.zero_tick, "first_index": [part.first_index for part in job.parts]}
        self._send(build_result(int(fields["id"]), error, outcome))

    def _extend(self, message: Message) -> None:
        order, points = _parse_points(message)
        job, error, done = self._jobs.get(order.job), None, False
        try:
            self._require_allowed(order, message.payload)
            done = job is not None and self._boards.extend(job, points)
        except OptodriveError as refusal:
            error = refusal
        self._send(build_result(int(message.fields["id"]), error, {"done": done}))

    def _require_allowed(self, order: PointsOrder, payload: bytes) -> None:
        """Raise NotReadyError for points of another epoch, of a board that is not armed, or that were damaged."""
        # The host's last refusal; behind it are only the session's times and the board's own guards.
        # Gate 1 of the epochs. The order of these checks is that of their reasons: the first one explains the others.
        if not self._epoch.is_current(order.epoch):
            raise NotReadyError(
                f"the plan is of epoch {order.epoch}, now is {self._epoch.number}: {self._epoch.reason}"
            )
        if not self._pauses.permits(order.pause):
            raise NotReadyError("the light is paused, or was since the plan was made")
        if not self._boards.connected or self._boards.state not in ARMED_STATES:
            raise NotReadyError(f"the board is {self._boards.state}; arm it first")
        # Over the bytes as the limiter verified them: a fault in memory or on the way is no light.
        if order.crc != zlib.crc32(payload):
            raise NotReadyError(DAMAGED_POINTS)

    def _truncate(self, message: Message) -> None:
        kept_points = [int(count) for count in message.fields["kept_points"]]
        done = bool(self._jobs) and self._boards.truncate(kept_points)
        self._send(build_result(int(message.fields["id"]), None, {"done": done}))

    def _flush(self, message: Message) -> None:
        self.clear()
        if self._boards.connected:
            self._boards.flush()

    def _delay(self, message: Message) -> None:
        job = self._jobs.get(int(message.fields["job"]))
        if job is not None:
            job.delay(int(message.fields["ticks"]))

    def _forward_executed(self, stage: int, message: m.Executed) -> None:
        for number, job in self._jobs.items():
            part = job.parts[stage]
            first = message.first_index - part.first_index
            begin, end = max(0, -first), min(len(message.records), part.end_index - message.first_index)
            if begin < end:
                records = b"".join(EXECUTED.pack(*record) for record in message.records[begin:end])
                last = self._executed[-1] if self._executed else None
                if last is None or (last.number, last.stage, last.end_point) != (number, stage, first + begin):
                    last = _ExecutedReport(number, stage, first + begin, bytearray())
                    self._executed.append(last)
                last.records.extend(records)

    def _send_executed(self) -> None:
        for report in self._executed:
            fields = {"job": report.number, "stage": report.stage, "first_point": report.first_point}
            self._send(Message("executed", fields, bytes(report.records)))
        self._executed.clear()

    def report_progress(self) -> None:
        """Send the progress that has changed since the last report if one is due, and forget finished jobs."""
        now_s = self._clock.now_s()
        is_finished = any(job.is_finished for job in self._jobs.values())
        # The end of a job is news at once: the next one waits for it.
        if not is_finished and now_s - self._reported_s < REPORT_INTERVAL_S:
            return
        self._report_jobs()

    def _report_jobs(self) -> None:
        self._reported_s = self._clock.now_s()
        # Before the progress: a job whose end is known has all its reports.
        self._send_executed()
        for number, job in list(self._jobs.items()):
            sent_points = [part.next_to_send - part.first_index for part in job.parts]
            progress = sent_points, self._boards.find_first_sent_tick(job), job.is_finished
            if self._progress.get(number) == progress:
                continue
            self._progress[number] = progress
            _, first_sent_tick, finished = progress
            first_index = [part.first_index for part in job.parts]
            fields: dict[str, Any] = {"job": number, "first_index": first_index, "sent_points": sent_points}
            fields |= {"first_sent_tick": first_sent_tick, "finished": finished}
            self._send(Message("progress", fields))
            if finished:
                del self._jobs[number], self._progress[number]


def _parse_points(message: Message) -> tuple[PointsOrder, StagePoints]:
    order = PointsOrder.from_fields(message.fields)
    return order, StagePoints.from_payload(message.payload, order.counts)


def _parse_kept(fields: dict[str, Any], points: StagePoints) -> list[int]:
    kept_points = [int(count) for count in fields["kept_points"]]
    if len(kept_points) != len(points.stages):
        raise ValueError(f"{len(kept_points)} counts for {len(points.stages)} stages")
    return kept_points
