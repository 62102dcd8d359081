"""The planner's view of the session that the link process owns.

Names follow `BoardSession`. One thread calls everything but `board_s`, which any thread may call.
"""

import select
import time
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError
from optodrive.core.histogram import Histogram
from optodrive.core.ipc import IpcClosed, IpcError, Message, MessageSocket
from optodrive.link.protocol.messages import Executed
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.stage_points import DAMAGED_POINTS, StagePoints
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.clock_reading import ClockReading
from optodrive.link.session.lease_renewal import AGE_BUCKETS_S
from optodrive.link.session.link_watch import LinkCause
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.stage_loss import LostStage
from optodrive.link.session.staged_job import StagedJob

REPLY_TIMEOUT_S = 0.6
"""Longest wait for the link process: longer than a stall of a busy computer, which is for the lease to judge, and
shorter than the age of a beat at which the link process counts its caller as stalled."""
NO_EPOCH = 0
"""Epoch while the link process is not reached. No request carries it."""
EXECUTED_RECORD = np.dtype([("on_tick", "<u8"), ("on_ticks", "<u4"), ("duty", "<u2")])
"""Record of an executed point in a message of kind `executed`."""


class RemoteJob(StagedJob):
    """Points of one plan in the link process, updated from its messages. Indices are the boards' once it has begun.

    number: by which planner and link process call it; start_ticks: at which the points of each stage begin
    """

    def __init__(
        self,
        session: "RemoteSession",
        number: int,
        points: StagePoints,
        zero_tick: int,
        start_ticks: Sequence[int] | None = None,
    ) -> None:
        starts = [zero_tick] * len(points.stages) if start_ticks is None else start_ticks
        pairs = zip(points.stages, starts, strict=True)
        super().__init__([PlanJob(number, one, 0, start_tick) for one, start_tick in pairs], zero_tick)
        self.number = number
        self._session = session
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
        self._session.send_delay(self.number, ticks)


class LeaseStats:
    """Statistics of the lease renewals.

    ages: distribution of their intervals, s; slack_s: minimum remaining lease
    """

    def __init__(self) -> None:
        self.ages = Histogram(AGE_BUCKETS_S)
        self.slack_s: float | None = None


class RemoteSession:
    """Connection of the planner to the link process.

    scales: of the board of each stage
    epoch: latest epoch, NO_EPOCH without a link process; epoch_reason: what raised it, as an end of a sentence
    connected: whether the link process is reached and its link to the board is up
    port: name of the board's port; board: latest reported state of the board; stats: link statistics
    stages: of several, name, port, board and clock of each
    lost: the stage that was lost while the others go on, None without; dark_s: host time from which every board that
    was lost so far is dark for certain
    control: who armed the board, None while it is not armed
    pause_ends_in_s: time until the pause ends disarmed, None if the light is not paused
    is_realtime: whether the link process runs before all programs of usual priority
    """

    def __init__(self, scales: Sequence[WireScale], clock: Clock) -> None:
        self.scales = tuple(scales)
        self.tick_s = scales[0].tick_s
        self.epoch = NO_EPOCH
        self.epoch_reason = ""
        self.connected = False
        self.link_error: str | None = "the link process is not reached yet"
        self.link_error_code: str | None = "link"
        self.port = ""
        self.board = BoardView()
        self.stats: dict[str, Any] = {}
        self.stages: list[dict[str, Any]] = []
        self.lost: LostStage | None = None
        self.dark_s = -inf
        self.faults: Counter[str] = Counter()
        self.lease = LeaseStats()
        self.is_acknowledged = self.is_realtime = False
        self.control: dict[str, Any] | None = None
        self.pause_ends_in_s: float | None = None
        self.last_event_reason = ""
        self.likely_cause: LinkCause | None = None
        self._clock = clock
        self._socket: MessageSocket | None = None
        self._clock_sample: tuple[float, float] | None = None
        self._clock_shift_s: float | None = None
        self._reported_ready = False
        self._commands_sent = self._commands_seen = 0
        self._refusal: str | None = None
        self._pause_number = self._drained_number = 0
        self._drained_s: float | None = None
        self._jobs: dict[int, RemoteJob] = {}
        self._job_number = self._request_id = 0
        self._on_result: Callable[[dict[str, Any]], None] | None = None

    # --- connection ---------------------------------------------------------------------------------------------

    def connect(self, path: Path) -> None:
        """Connect to the link process, in place of an earlier connection. Raise LinkError if it does not listen."""
        self.close()
        try:
            self._socket = MessageSocket.connect(path)
            self._commands_sent = self._commands_seen = 0
            self._socket.send(Message("hello", {"role": "planner"}))
        except (OSError, IpcError) as error:
            self._on_lost(f"the link process does not answer at {path}: {error}")
            raise LinkError(self.link_error or "") from None

    @property
    def is_attached(self) -> bool:
        """Whether the link process is connected, with or without a board."""
        return self._socket is not None

    def fileno(self) -> int:
        """Return the descriptor that is readable when messages have arrived, −1 without a connection."""
        return -1 if self._socket is None else self._socket.fileno()

    @property
    def wants_write(self) -> bool:
        """Whether bytes wait until the link process reads. receive() sends them, too."""
        return self._socket is not None and self._socket.wants_write

    def receive(self) -> None:
        """Process messages that have arrived, a bounded number, and send the messages that wait.

        Never wait; a lost connection is no error.
        """
        if self._socket is None:
            return
        try:
            if self._socket.wants_write:
                self._socket.flush()
            for message in self._socket.receive():
                self._on_message(message)
        except IpcError as error:
            self._on_lost(f"the link process has ended: {error}")

    def close(self) -> None:
        """End the connection. The link process then turns the gate off."""
        if self._socket is not None:
            self._on_lost("the planner has ended its connection to the link process")

    def _on_lost(self, message: str) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self.connected = self.is_acknowledged = self._reported_ready = False
        self.pause_ends_in_s = None
        self.epoch, self.epoch_reason = NO_EPOCH, message
        self.link_error, self.link_error_code = message, "link"
        self._jobs.clear()

    def _send(self, message: Message) -> None:
        if self._socket is None:
            raise LinkError(self.link_error or "")
        try:
            self._socket.send(message)
        except IpcClosed as error:
            self._on_lost(f"the link process has ended: {error}")
            raise LinkError(self.link_error or "") from None

    def _send_command(self, kind: str, fields: dict[str, Any], payload: bytes = b"") -> None:
        self._commands_sent += 1
        self._send(Message(kind, fields, payload))

    def _request(
        self, kind: str, fields: dict[str, Any], payload: bytes, on_result: Callable[[dict[str, Any]], None]
    ) -> None:
        """Send a request and wait for its result, unless the link process is lost or does not answer in time.

        on_result: called with the result before any later message is processed
        """
        self._request_id += 1
        self._on_result = on_result
        with suppress(LinkError):
            self._send_command(kind, {"id": self._request_id, **fields}, payload)
        deadline_s = self._clock.now_s() + REPLY_TIMEOUT_S
        while self._socket is not None and self._on_result is not None:
            wait_s = deadline_s - self._clock.now_s()
            writable = [self._socket] if self._socket.wants_write else []
            # Without time left, read once more: this process may have waited for the processor.
            select.select([self._socket], writable, [], max(0.0, wait_s))
            self.receive()
            if wait_s <= 0.0 and self._is_waiting():
                self._on_lost(f"the link process did not answer {kind} within {REPLY_TIMEOUT_S:g} s")
        self._on_result = None

    def _is_waiting(self) -> bool:
        return self._on_result is not None

    # --- messages of the link process ---------------------------------------------------------------------------

    def _on_message(self, message: Message) -> None:
        fields = message.fields
        if message.kind == "status":
            self._on_status(fields)
        elif message.kind == "executed":
            self._on_executed(fields, message.payload)
        elif message.kind == "progress":
            self._on_progress(fields)
        elif message.kind == "job_refused":
            self._jobs.pop(fields["job"], None)
            if not fields["paused"]:  # else the planner hands the plan over again, see pop_drained()
                self._keep_refusal(fields["reason"])
        elif message.kind == "drained":
            self._on_drained(fields["pause"], fields["board_s"])
        elif message.kind == "refusal":
            self._keep_refusal(fields["reason"])
        elif message.kind == "result" and fields["id"] == self._request_id and self._on_result is not None:
            on_result, self._on_result = self._on_result, None
            on_result(fields)

    def _keep_refusal(self, reason: str) -> None:
        if self._refusal is None:  # the first refusal causes the following ones
            self._refusal = reason

    def _on_status(self, fields: dict[str, Any]) -> None:
        pause = fields["pause"]
        self._pause_number, self.pause_ends_in_s = pause["number"], pause["ends_in_s"]
        if fields["epoch"] != self.epoch:
            self._jobs.clear()
            self._drained_number, self._drained_s = pause["number"], None
        self.epoch, self.epoch_reason = fields["epoch"], fields["epoch_reason"]
        self._update_clock(fields["clock"], fields["connected"])
        self.connected, self.port = fields["connected"], fields["port"]
        self.link_error, self.link_error_code = fields["link_error"], fields["link_error_code"]
        board = {name: value for name, value in fields["board"].items() if name != "hint"}
        self.board = BoardView(**{**board, "fault": board["fault"] or ""})
        self.stats, self.faults, self.stages = fields["stats"], Counter(fields["faults"]), fields["stages"]
        self._take_lost(fields["lost"])
        self.lease.ages.load(fields["lease"]["counts"], fields["lease"]["sum_s"])
        self.lease.slack_s = fields["lease"]["slack_s"]
        self.is_acknowledged, self._reported_ready = fields["is_acknowledged"], fields["is_ready"]
        self.control, self._commands_seen = fields["control"], fields["commands"]
        self.is_realtime = fields["is_realtime"]
        self.last_event_reason = fields["last_event_reason"]
        self.likely_cause = None if fields["cause"] is None else LinkCause(*fields["cause"])

    def _take_lost(self, fields: dict[str, Any] | None) -> None:
        self.lost = None if fields is None else LostStage(**fields)
        if self.lost is not None:
            self.dark_s = max(self.dark_s, self.lost.dark_s)

    def _update_clock(self, sample: list[float] | None, connected: bool) -> None:
        if sample is None or not connected:
            return
        midpoint_s, board_s = sample
        if not self.connected and self._clock_sample is not None:
            now_s = self._clock.now_s()
            self._clock_shift_s = board_s + (now_s - midpoint_s) - self.board_s()
        self._clock_sample = midpoint_s, board_s

    def _on_progress(self, fields: dict[str, Any]) -> None:
        job = self._jobs.get(fields["job"])
        if job is None:
            return
        job.update(fields["first_index"], fields["sent_points"], fields["first_sent_tick"])
        if fields["finished"]:
            del self._jobs[fields["job"]]

    def _on_drained(self, number: int, board_s: float) -> None:
        self._jobs.clear()
        self._drained_number = number
        if self._drained_s is None:
            self._drained_s = board_s

    def _on_executed(self, fields: dict[str, Any], payload: bytes) -> None:
        job = self._jobs.get(fields["job"])
        if job is not None:
            records = tuple(np.frombuffer(payload, EXECUTED_RECORD).tolist())
            part = job.parts[fields["stage"]]
            part.record_executed(Executed(part.first_index + fields["first_point"], records))

    # --- state --------------------------------------------------------------------------------------------------

    def read_clocks(self) -> ClockReading | None:
        """Return the present time on all clocks, None before the first status with a synchronised clock."""
        sample, now_s = self._clock_sample, self._clock.now_s()
        if sample is None:
            return None
        return ClockReading(sample[1] + (now_s - sample[0]), now_s, time.time())

    def board_s(self) -> float:
        """Return the present board time, s, or 0 before the first status with a synchronised clock."""
        sample = self._clock_sample
        return 0.0 if sample is None else sample[1] + (self._clock.now_s() - sample[0])

    @property
    def is_ready(self) -> bool:
        """Whether a job may start now. False until the link process has carried out all commands sent."""
        all_seen = self._commands_seen == self._commands_sent
        return self.connected and self._reported_ready and all_seen and not self.is_held

    @property
    def is_held(self) -> bool:
        """Whether the light is paused, or reports of pulses emitted before a pause may still arrive."""
        return self.pause_ends_in_s is not None or self._drained_number != self._pause_number

    @property
    def is_interrupted(self) -> bool:
        """Whether the light is held because a stage was lost, and not by a pause."""
        return self.is_held and self.pause_ends_in_s is None and self.lost is not None

    def pop_drained(self) -> float | None:
        """Return and clear the board time at which a pause began, s, when all is reported that was executed before it.

        The link process has dropped all jobs; it refuses points that were handed over before.
        """
        drained_s, self._drained_s = self._drained_s, None
        return drained_s

    def pop_refusal(self) -> str | None:
        """Return and clear the reason for which link process or board refused a command."""
        refusal, self._refusal = self._refusal, None
        return refusal

    def pop_clock_shift(self) -> float | None:
        """Return and clear the jump of the board's clock at a reconnection, s, None without a reconnection."""
        shift_s, self._clock_shift_s = self._clock_shift_s, None
        return shift_s

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
        job = RemoteJob(self, self._job_number, points, max(1, round(start_s / self.tick_s)))
        self._jobs[job.number] = job
        fields = {
            "job": job.number,
            "epoch": epoch,
            "pause": self._drained_number,
            "start_s": start_s,
            **_build_points_fields(points, payload, send_ahead_s, crc),
        }
        try:
            self._send_command("begin", fields, payload)
        except LinkError as error:
            self._keep_refusal(str(error))
        return job

    def splice(
        self,
        points: StagePoints,
        kept_points: Sequence[int],
        zero_s: float,
        epoch: int,
        send_ahead_s: float,
        crc: int | None = None,
    ) -> RemoteJob | None:
        """Truncate the last job to `kept_points` points of each stage and continue with `points` without a pause.

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
            points, crc = points.add_pauses([zero_tick - tick for tick in start_ticks]), None
        payload = points.encode_payload()
        self._job_number += 1
        number = self._job_number
        fields = {"job": number, "epoch": epoch, "pause": self._drained_number, "kept_points": list(kept_points)}

        added: list[RemoteJob] = []

        def add_job(result: dict[str, Any]) -> None:
            if result["start_tick"] is not None:
                last.truncate(kept_points)
                if len(self.scales) > 1:
                    job = RemoteJob(self, number, points, zero_tick, start_ticks)
                else:
                    job = RemoteJob(self, number, points, result["start_tick"])
                job.update(result["first_index"], [0] * len(job.parts), None)
                self._jobs[number] = job
                added.append(job)  # a job without points may be finished, and forgotten, before the next line is read

        self._request("splice", fields | _build_points_fields(points, payload, send_ahead_s, crc), payload, add_job)
        return added[0] if added and self._socket is not None else None

    def truncate(self, kept_points: Sequence[int]) -> bool:
        """Truncate the last job to `kept_points` points of each stage. Return False, unchanged, if more were sent."""
        last = self._find_last_job()
        results: list[dict[str, Any]] = []
        if last is not None:
            self._request("truncate", {"kept_points": list(kept_points)}, b"", results.append)
        return last is not None and bool(results) and results[0]["done"] and last.truncate(kept_points)

    def flush(self) -> None:
        """Turn the gate off and drop the queue. The board stays armed."""
        self._jobs.clear()
        with suppress(LinkError):
            self._send_command("flush", {})

    def beat(self, alive: bool) -> None:
        """Prove that the planner's loop runs. alive: whether planning makes progress or is idle."""
        with suppress(LinkError):
            self._send(Message("beat", {"alive": alive}))

    def send_delay(self, number: int, ticks: int) -> None:
        """Shift the zero of a job in the link process."""
        with suppress(LinkError):
            self._send_command("delay", {"job": number, "ticks": ticks})

    def _find_last_job(self) -> RemoteJob | None:
        return next(reversed(self._jobs.values()), None)


def _build_points_fields(points: StagePoints, payload: bytes, send_ahead_s: float, crc: int | None) -> dict[str, Any]:
    ahead_s = None if send_ahead_s == inf else send_ahead_s
    return {"counts": points.counts, "ahead_s": ahead_s, "crc": zlib.crc32(payload) if crc is None else crc}
