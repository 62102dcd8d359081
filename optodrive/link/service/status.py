"""Status of the link process for its clients: on each change, and at least every tenth of a second."""

from math import inf

from optodrive.core.clock import Clock
from optodrive.core.ipc import Message
from optodrive.core.processes import has_realtime_priority
from optodrive.link.service.control import Control, Epoch, Pauses
from optodrive.link.session.board_group import BoardGroup

INTERVAL_S = 0.1


class StatusPublisher:
    """Builder of the messages of kind `status`."""

    def __init__(self, boards: BoardGroup, clock: Clock) -> None:
        self._boards = boards
        self._clock = clock
        self._due_s = -inf
        self._published: tuple[object, ...] = ()

    def mark_due(self) -> None:
        """Publish at the next opportunity, for a new client."""
        self._due_s = -inf

    def build_if_due(
        self,
        epoch: Epoch,
        control: Control | None,
        pauses: Pauses,
        commands: int,
        stalled: str,
    ) -> Message | None:
        """Return the status if something relevant has changed or the interval has passed, else None.

        control: who armed the board; commands: number of the planner's commands carried out since it connected
        stalled: role of the process that withholds the lease, so that the board cannot be armed; '' if none does
        """
        boards, link_error = self._boards, self._boards.link_error
        outcome = boards.is_ready, boards.last_event_reason, boards.likely_cause
        causes = None if control is None else control.arming, commands, stalled, *outcome
        pause = pauses.number, pauses.is_paused
        links = boards.connected, None if link_error is None else str(link_error)
        states = tuple(session.board.state for session in boards.sessions)
        key = (epoch.number, pause, links, states, boards.lost, boards.state, boards.fault, *causes)
        now_s = self._clock.now_s()
        if key == self._published and now_s < self._due_s:
            return None
        self._published, self._due_s = key, now_s + INTERVAL_S
        cause, sample = boards.likely_cause, boards.clock_sample
        fields = {
            "epoch": epoch.number,
            "epoch_reason": epoch.reason,
            "connected": boards.connected,
            "link_error": None if link_error is None else str(link_error),
            "link_error_code": None if link_error is None else link_error.code,
            "port": boards.port,
            "board": boards.board.to_dict(),
            "stats": boards.collect_link_stats(),
            "faults": dict(boards.faults),
            "lease": {
                "counts": boards.lease.ages.counts,
                "sum_s": boards.lease.ages.sum,
                "slack_s": boards.lease.slack_s,
            },
            "clock": None if sample is None else list(sample),
            "is_ready": boards.connected and boards.is_ready and not pauses.is_paused,
            "is_acknowledged": boards.is_acknowledged,
            "last_event_reason": boards.last_event_reason,
            "cause": None if cause is None else list(cause),
            "pause": pauses.to_dict(),
            "control": None if control is None else control.to_dict(now_s),
            "commands": commands,
            "stalled": stalled,
            "stages": boards.list_stages(),
            "lost": None if boards.lost is None else boards.lost.to_dict(),
            "is_realtime": has_realtime_priority(),
        }
        return Message("status", fields)
