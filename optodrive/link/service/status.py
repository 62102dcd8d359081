"""Status of the link process for its clients: on each change, and at least every tenth of a second."""

from math import inf

from optodrive.core.clock import Clock
from optodrive.core.errors import OptodriveError
from optodrive.core.ipc import Message
from optodrive.core.scheduling import has_realtime_priority
from optodrive.link.service.control import Control
from optodrive.link.service.epoch import Epoch
from optodrive.link.service.pauses import Pauses
from optodrive.link.session.session import BoardSession

INTERVAL_S = 0.1


class StatusPublisher:
    """Builder of the messages of kind `status`."""

    def __init__(self, session: BoardSession, clock: Clock) -> None:
        self._session = session
        self._clock = clock
        self._due_s = -inf
        self._published: tuple[object, ...] = ()

    def mark_due(self) -> None:
        """Publish at the next opportunity, for a new client."""
        self._due_s = -inf

    def build_if_due(
        self,
        epoch: Epoch,
        link_error: OptodriveError | None,
        control: Control | None,
        pauses: Pauses,
        commands: int,
        stalled: str,
    ) -> Message | None:
        """Return the status if something relevant has changed or the interval has passed, else None.

        control: who armed the board; commands: number of the planner's commands carried out since it connected
        stalled: role of the process that withholds the lease, so that the board cannot be armed; '' if none does
        """
        session, board = self._session, self._session.board
        outcome = session.is_ready, session.last_event_reason, session.likely_cause
        causes = None if control is None else control.arming, commands, stalled, *outcome
        pause = pauses.number, pauses.is_paused
        key = (epoch.number, pause, session.connected, link_error, board.state, board.fault, *causes)
        now_s = self._clock.now_s()
        if key == self._published and now_s < self._due_s:
            return None
        self._published, self._due_s = key, now_s + INTERVAL_S
        cause, sample = session.likely_cause, session.clock_sample
        fields = {
            "epoch": epoch.number,
            "epoch_reason": epoch.reason,
            "connected": session.connected,
            "link_error": None if link_error is None else str(link_error),
            "link_error_code": None if link_error is None else link_error.code,
            "port": session.port,
            "board": board.to_dict(),
            "stats": session.collect_link_stats(),
            "faults": dict(session.faults),
            "lease": {
                "counts": session.lease.ages.counts,
                "sum_s": session.lease.ages.sum,
                "slack_s": session.lease.slack_s,
            },
            "clock": None if sample is None else list(sample),
            "is_ready": session.connected and session.is_ready and not pauses.is_paused,
            "is_acknowledged": session.is_acknowledged,
            "last_event_reason": session.last_event_reason,
            "cause": None if cause is None else list(cause),
            "pause": pauses.to_dict(),
            "control": None if control is None else control.to_dict(now_s),
            "commands": commands,
            "stalled": stalled,
            "is_realtime": has_realtime_priority(),
        }
        return Message("status", fields)
