"""Handover of the planner's points to the session, and the reports of their execution to the planner."""

import struct
import zlib
from collections.abc import Callable
from math import inf
from typing import Any, NamedTuple

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import NotReadyError, OptodriveError
from optodrive.core.ipc import Message
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.link.protocol.states import ARMED_STATES
from optodrive.link.service.epoch import Epoch
from optodrive.link.service.pauses import Pauses
from optodrive.link.service.results import build_result
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.session import BoardSession

EXECUTED = struct.Struct("<QIH")
"""Executed point in a message: tick of gate on, gate-on time in ticks, duty."""
POINT_COLUMNS = 5
REPORT_INTERVAL_S = 0.01
"""Interval of the reports to the planner, so that it need not process a message per pulse."""


class _ExecutedReport(NamedTuple):
    """Executed points of a job, from first_point on."""

    number: int
    first_point: int
    records: bytearray

    @property
    def end_point(self) -> int:
        return self.first_point + len(self.records) // EXECUTED.size


class PointHandover:
    """Jobs of the planner in the present epoch, under the planner's numbers.

    send: sends a message to the planner; commands: number of commands since the planner connected
    """

    def __init__(
        self,
        session: BoardSession,
        clock: Clock,
        epoch: Epoch,
        pauses: Pauses,
        send: Callable[[Message], None],
    ) -> None:
        self.commands = 0
        self._session = session
        self._clock = clock
        self._epoch = epoch
        self._pauses = pauses
        self._is_draining = False
        self._send = send
        self._jobs: dict[int, PlanJob] = {}
        self._progress: dict[int, tuple[int, float | None, bool]] = {}
        self._executed: list[_ExecutedReport] = []
        self._reported_s = -inf
        session.on_executed = self._forward_executed

    def clear(self) -> None:
        """Report what was executed, and forget all jobs."""
        self._send_executed()
        self._jobs.clear()
        self._progress.clear()

    def pause(self) -> None:
        """Turn the gate off and drop the queue. The planner is told when all is reported that was executed."""
        self._is_draining = True
        self._session.drain()

    def finish_pause(self) -> None:
        """Tell the planner, once, that a pause has no more reports."""
        if self._is_draining and not self._session.is_draining:
            self._is_draining = False
            self.clear()
            self._send(Message("drained", {"pause": self._pauses.number, "board_s": self._pauses.began_s}))

    def carry_out(self, message: Message) -> None:
        """Carry out a command of the planner. Raise KeyError, TypeError or ValueError if it is malformed."""
        self.commands += 1
        {
            "begin": self._begin,
            "splice": self._splice,
            "truncate": self._truncate,
            "flush": self._flush,
            "delay": self._delay,
        }[message.kind](message)

    def _begin(self, message: Message) -> None:
        fields = message.fields
        number, start_s, points = int(fields["job"]), float(fields["start_s"]), _parse_points(message.payload)
        try:
            self._require_allowed(message)
            if self._session.has_points:
                raise NotReadyError("the board still executes an earlier job")
        except OptodriveError as error:
            paused = not self._permits(message)
            self._send(Message("job_refused", {"job": number, "reason": str(error), "paused": paused}))
            return
        self._jobs[number] = self._session.begin(points, start_s, _parse_ahead_s(fields))

    def _splice(self, message: Message) -> None:
        fields, points = message.fields, _parse_points(message.payload)
        job, error = None, None
        try:
            self._require_allowed(message)
            job = self._session.splice(points, int(fields["kept_points"]), _parse_ahead_s(fields))
        except OptodriveError as refusal:
            error = refusal
        outcome: dict[str, Any] = {"start_tick": None, "first_index": None}
        if job is not None:
            self._jobs[int(fields["job"])] = job
            outcome = {"start_tick": job.start_tick, "first_index": job.first_index}
        self._send(build_result(int(fields["id"]), error, outcome))

    def _require_allowed(self, message: Message) -> None:
        """Raise NotReadyError for points of another epoch, of a board that is not armed, or that were damaged."""
        epoch, crc = int(message.fields["epoch"]), int(message.fields["crc"])
        if not self._epoch.is_current(epoch):
            raise NotReadyError(f"the plan is of epoch {epoch}, now is {self._epoch.number}: {self._epoch.reason}")
        if not self._permits(message):
            raise NotReadyError("the light is paused, or was since the plan was made")
        if not self._session.connected or self._session.board.state not in ARMED_STATES:
            raise NotReadyError(f"the board is {self._session.board.state}; arm it first")
        if crc != zlib.crc32(message.payload):
            raise NotReadyError("the points differ from those that were verified (CRC-32)")

    def _permits(self, message: Message) -> bool:
        return self._pauses.permits(int(message.fields["pause"]))

    def _truncate(self, message: Message) -> None:
        done = bool(self._jobs) and self._session.truncate(int(message.fields["kept_points"]))
        self._send(build_result(int(message.fields["id"]), None, {"done": done}))

    def _flush(self, message: Message) -> None:
        self.clear()
        if self._session.connected:
            self._session.flush()

    def _delay(self, message: Message) -> None:
        job = self._jobs.get(int(message.fields["job"]))
        if job is not None:
            job.delay(int(message.fields["ticks"]))

    def _forward_executed(self, message: m.Executed) -> None:
        for number, job in self._jobs.items():
            first = message.first_index - job.first_index
            begin, end = max(0, -first), min(len(message.records), job.end_index - message.first_index)
            if begin < end:
                records = b"".join(EXECUTED.pack(*record) for record in message.records[begin:end])
                last = self._executed[-1] if self._executed else None
                if last is None or last.number != number or last.end_point != first + begin:
                    last = _ExecutedReport(number, first + begin, bytearray())
                    self._executed.append(last)
                last.records.extend(records)

    def _send_executed(self) -> None:
        for report in self._executed:
            fields = {"job": report.number, "first_point": report.first_point}
            self._send(Message("executed", fields, bytes(report.records)))
        self._executed.clear()

    def report_progress(self) -> None:
        """Send what has changed since the last report if one is due, and forget finished jobs."""
        now_s = self._clock.now_s()
        is_finished = any(job.is_finished for job in self._jobs.values())
        if not is_finished and now_s - self._reported_s < REPORT_INTERVAL_S:
            return
        self._reported_s = now_s
        self._send_executed()
        for number, job in list(self._jobs.items()):
            progress = job.next_to_send - job.first_index, job.first_sent_tick, job.is_finished
            if self._progress.get(number) == progress:
                continue
            self._progress[number] = progress
            sent_points, first_sent_tick, finished = progress
            fields: dict[str, Any] = {"job": number, "first_index": job.first_index, "sent_points": sent_points}
            fields |= {"first_sent_tick": first_sent_tick, "finished": finished}
            self._send(Message("progress", fields))
            if finished:
                del self._jobs[number], self._progress[number]


def _parse_points(payload: bytes) -> WirePoints:
    table = np.frombuffer(payload, dtype="<u2").reshape(-1, POINT_COLUMNS)
    return WirePoints(table, np.zeros(len(table), dtype=np.int64))


def _parse_ahead_s(fields: dict[str, Any]) -> float:
    return inf if fields["ahead_s"] is None else float(fields["ahead_s"])
