"""The status of a plan, and which one may follow which."""

from enum import StrEnum


class PlanStatus(StrEnum):
    """The status of a plan. That of a dry run stays `planned`.

    stopped: STOP or disarm ended it; failed: a fault, a lost link or a lost caller did
    """

    PLANNED = "planned"
    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    DONE = "done"
    SUPERSEDED = "superseded"
    STOPPED = "stopped"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def has_ended(self) -> bool:
        """Whether the status is final."""
        return self in ENDS

    def may_become(self, status: "PlanStatus") -> bool:
        """Return whether another status may follow this one."""
        return status in TRANSITIONS[self]


ENDS = (PlanStatus.DONE, PlanStatus.SUPERSEDED, PlanStatus.STOPPED, PlanStatus.FAILED, PlanStatus.CANCELLED)
TRANSITIONS: dict[PlanStatus, frozenset[PlanStatus]] = {
    PlanStatus.PLANNED: frozenset({PlanStatus.QUEUED, PlanStatus.RUNNING}),  # running at once: spliced behind another
    PlanStatus.QUEUED: frozenset({PlanStatus.RUNNING, *ENDS}),
    PlanStatus.RUNNING: frozenset({PlanStatus.PAUSED, *ENDS}),
    PlanStatus.PAUSED: frozenset({PlanStatus.RUNNING, *ENDS}),
} | dict.fromkeys(ENDS, frozenset())
