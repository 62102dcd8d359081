"""The jobs of the preview process: parse and build a pushed body, or plan it without executing it.

Waiting jobs are bounded for each kind and each caller.
"""

import pickle
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from optodrive.core.errors import BusyError, OptodriveError
from optodrive.core.ipc import Message, MessageSocket
from optodrive.core.json_model import iterate_json
from optodrive.daemon.engine.plan_making import DryRunStart, PlanningRequest, PlanningSnapshot, dim_display, make_plan
from optodrive.daemon.push import BuiltRequest, Push, build_request
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.problem import build_error_problem
from optodrive.link.protocol.quantisation import WireScale
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli.sequence_file import encode_sequence

DRY_RUN_PLAN = "dry-run"
"""Plan id of every dry run."""


def run_job(display: DisplayModel, scales: Sequence[WireScale], job: Message) -> Message:
    """Do a job and return its result: status and payload, or the status and the document of a problem."""
    try:
        body, start = _split_payload(job)
        push = Push(**job.fields["push"])
        built = build_request(display, job.fields["source"], push.name, body)
        if start is None:
            fields = {"status": 200, "labels": dict(built.labels), "parameters": dict(built.parameters)}
            return Message("result", fields, encode_sequence(built.sequence))
        report = plan_dry_run(display, scales, built, start, push)
        audit = {"plan": report.plan, "pattern": report.name, "pulses": report.planned, "plan_status": report.status}
        return Message("result", {"status": 200, "audit": audit}, b"".join(iterate_json(report)))
    except OptodriveError as error:
        return build_refusal(error)


def build_refusal(error: OptodriveError) -> Message:
    """Build the result that describes an error."""
    problem = build_error_problem(error)
    return Message("result", {"status": problem.status}, problem.to_json())


def _split_payload(job: Message) -> tuple[bytes, DryRunStart | None]:
    """Return the body, and the start of a dry run."""
    if job.kind == "build":
        return job.payload, None
    snapshot_bytes = job.fields["snapshot_bytes"]
    start: DryRunStart = pickle.loads(job.payload[:snapshot_bytes])  # noqa: S301 - from the planner process
    return job.payload[snapshot_bytes:], start


def plan_dry_run(
    display: DisplayModel, scales: Sequence[WireScale], built: BuiltRequest, start: DryRunStart, push: Push
) -> PlanReport:
    """Plan and prove a sequence without executing it. Raise InputError or RefusedError as the planner does."""
    request = PlanningRequest(lambda: built, push)
    snapshot = PlanningSnapshot(start.before, start.starts_in_s, start.before)
    dimmed = dim_display(display.without_stage(start.lost_stage), start.power_share)
    plan = make_plan(dimmed, scales, request, built, snapshot, DRY_RUN_PLAN, lambda fraction: None)
    return plan.record.build_report(0.0)


WAITING_MAX: Mapping[str, int] = {"build": 16, "dry_run": 16}
"""Waiting jobs of one kind: of as many callers, which get a place each."""
CALLER_WAITING_MAX = 4
"""Waiting jobs of one caller and kind, so that one caller cannot fill the queue."""


class Job(NamedTuple):
    """A job with the connection that waits for its result.

    is_slow: a build that took longer than usual, and was begun or begins again as a slow job
    """

    client: MessageSocket
    message: Message
    is_slow: bool = False

    @property
    def is_heavy(self) -> bool:
        """Whether it runs beside the usual builds, at low priority: a dry run or a slow build."""
        return self.is_slow or self.message.kind == "dry_run"

    @property
    def job_id(self) -> int:
        """Id of the job within its connection."""
        number: int = self.message.fields["id"]
        return number

    @property
    def caller(self) -> str:
        """Name of the caller, '' if unknown."""
        return str(self.message.fields["push"]["caller"])


class JobQueue:
    """Jobs that wait for a worker. Callers take turns, and share the queue evenly where it is full."""

    def __init__(self) -> None:
        self._jobs: list[Job] = []
        self._turns: dict[str, int] = {}
        """Number of the last job of each caller that was taken."""

    def add(self, job: Job) -> Job | None:
        """Add a job. Return the one that had to leave a full queue for it, if any: the newest of the largest caller.

        Raise BusyError if too many of the caller's own jobs wait.
        """
        same_kind = [waiting for waiting in self._jobs if waiting.message.kind == job.message.kind]
        counts = Counter(waiting.caller for waiting in same_kind)
        if job.caller and counts[job.caller] >= CALLER_WAITING_MAX:
            raise build_busy_error(counts[job.caller])
        displaced = None
        if len(same_kind) >= WAITING_MAX[job.message.kind]:
            largest, count = counts.most_common(1)[0]
            if count <= counts[job.caller] + 1:
                raise build_busy_error(len(same_kind))
            displaced = next(waiting for waiting in reversed(same_kind) if waiting.caller == largest)
            self._jobs.remove(displaced)
        self._jobs.append(job)
        return displaced

    def put_back(self, job: Job) -> None:
        """Add a job again that was begun."""
        self._jobs.append(job)

    def take(self, may_start: Callable[[Job], bool], busy_callers: set[str]) -> Job | None:
        """Remove and return the next job that may start, None if there is none.

        It is that of a caller without a running job, of these that of the caller whose last turn was first.
        """
        candidates = [job for job in self._jobs if may_start(job)]
        if not candidates:
            return None
        job = min(candidates, key=lambda each: (each.caller in busy_callers, self._turns.get(each.caller, 0)))
        self._jobs.remove(job)
        self._turns[job.caller] = max(self._turns.values(), default=0) + 1
        return job

    def drop(self, client: MessageSocket, job_id: int | None = None) -> None:
        """Drop a job of a connection that has lost its caller, or all jobs of a lost connection."""
        self._jobs = [job for job in self._jobs if job.client is not client or job_id not in (None, job.job_id)]


def build_busy_error(waiting: int) -> BusyError:
    """Build the error of a job for which the queue has no room."""
    return BusyError(f"too many requests wait: {waiting} before this one; try again later")
