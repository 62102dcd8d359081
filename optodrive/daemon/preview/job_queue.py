"""Waiting jobs of the preview process, bounded for each kind and each caller."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from optodrive.core.errors import BusyError
from optodrive.core.ipc import Message, MessageSocket

WAITING_MAX: Mapping[str, int] = {"build": 8, "dry_run": 8}
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
    """Jobs that wait for a worker."""

    def __init__(self) -> None:
        self._jobs: list[Job] = []

    def add(self, job: Job) -> None:
        """Add a job. Raise BusyError if too many wait."""
        same_kind = [waiting for waiting in self._jobs if waiting.message.kind == job.message.kind]
        of_caller = [waiting for waiting in same_kind if job.caller and waiting.caller == job.caller]
        if len(same_kind) >= WAITING_MAX[job.message.kind] or len(of_caller) >= CALLER_WAITING_MAX:
            raise BusyError(f"too many requests wait: {len(same_kind)} before this one; try again later")
        self._jobs.append(job)

    def put_back(self, job: Job) -> None:
        """Add a job again that was begun."""
        self._jobs.append(job)

    def take(self, may_start: Callable[[Job], bool], busy_callers: set[str]) -> Job | None:
        """Remove and return the next job that may start: the first of a caller without a running job, else the first.

        Return None if there is none.
        """
        candidates = [job for job in self._jobs if may_start(job)]
        job = next((job for job in candidates if job.caller not in busy_callers), next(iter(candidates), None))
        if job is not None:
            self._jobs.remove(job)
        return job

    def drop(self, client: MessageSocket, job_id: int | None = None) -> None:
        """Drop a job of a connection that has lost its caller, or all jobs of a lost connection."""
        self._jobs = [job for job in self._jobs if job.client is not client or job_id not in (None, job.job_id)]
