"""The planner's view of the link process's status: epoch, board, clock and lease."""

import time
from collections import Counter
from collections.abc import Mapping
from math import inf
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.histogram import Histogram
from optodrive.link.session.arming import AGE_BUCKETS_S
from optodrive.link.session.board_view import BoardView
from optodrive.link.session.clock_sync import ClockReading
from optodrive.link.session.group_state import LostStage
from optodrive.link.session.link_watch import LinkCause

NO_EPOCH = 0
"""Epoch while the link process is not reached. No request carries it."""


class LinkStatus:
    """The last status. One thread calls everything but `board_s`, which any thread may call.

    epoch: latest epoch, NO_EPOCH without a link process; epoch_reason: what raised it, as an end of a sentence
    connected: whether the link process is reached and its link to the board is up
    port: name of the board's port; board: latest reported state of the board; stats: link statistics
    stages: of several, name, port, board and clock of each
    lost: the stage that was lost while the others go on, None without; dark_s: host time from which every board that
    was lost so far is dark for certain
    lease_ages: distribution of the intervals of the lease's renewals, s; lease_slack_s: minimum remaining lease
    control: who armed the board, None while it is not armed
    pause_ends_in_s: time until the pause ends disarmed, None if the light is not paused
    is_realtime: whether the link process runs before all programs of usual priority
    """

    def __init__(self, clock: Clock) -> None:
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
        self.lease_ages = Histogram(AGE_BUCKETS_S)
        self.lease_slack_s: float | None = None
        self.is_acknowledged = self.is_realtime = False
        self.control: dict[str, Any] | None = None
        self.pause_ends_in_s: float | None = None
        self.last_event_reason = ""
        self.likely_cause: LinkCause | None = None
        self._clock = clock
        self._clock_sample: tuple[float, float] | None = None
        self._clock_shift_s: float | None = None
        self._reported_ready = False
        self._commands_seen = self._pause_number = 0

    def _take_status(self, fields: Mapping[str, Any]) -> None:
        pause = fields["pause"]
        self._pause_number, self.pause_ends_in_s = pause["number"], pause["ends_in_s"]
        self.epoch, self.epoch_reason = fields["epoch"], fields["epoch_reason"]
        self._update_clock(fields["clock"], fields["connected"])
        self.connected, self.port = fields["connected"], fields["port"]
        self.link_error, self.link_error_code = fields["link_error"], fields["link_error_code"]
        board = {name: value for name, value in fields["board"].items() if name != "hint"}
        self.board = BoardView(**{**board, "fault": board["fault"] or ""})
        self.stats, self.faults, self.stages = fields["stats"], Counter(fields["faults"]), fields["stages"]
        self._take_lost(fields["lost"])
        self.lease_ages.load(fields["lease"]["counts"], fields["lease"]["sum_s"])
        self.lease_slack_s = fields["lease"]["slack_s"]
        self.is_acknowledged, self._reported_ready = fields["is_acknowledged"], fields["is_ready"]
        self.control, self._commands_seen = fields["control"], fields["commands"]
        self.is_realtime = fields["is_realtime"]
        self.last_event_reason = fields["last_event_reason"]
        self.likely_cause = None if fields["cause"] is None else LinkCause(*fields["cause"])

    def _take_lost(self, fields: Mapping[str, Any] | None) -> None:
        self.lost = None if fields is None else LostStage(**fields)
        if self.lost is not None:
            self.dark_s = max(self.dark_s, self.lost.dark_s)

    def _take_end(self, reason: str) -> None:
        self.connected = self.is_acknowledged = self._reported_ready = False
        self.pause_ends_in_s = None
        self.epoch, self.epoch_reason = NO_EPOCH, reason
        self.link_error, self.link_error_code = reason, "link"

    def _update_clock(self, sample: list[float] | None, connected: bool) -> None:
        if sample is None or not connected:
            return
        midpoint_s, board_s = sample
        if not self.connected and self._clock_sample is not None:
            now_s = self._clock.now_s()
            self._clock_shift_s = board_s + (now_s - midpoint_s) - self.board_s()
        self._clock_sample = midpoint_s, board_s

    def list_uids(self) -> list[str]:
        """Return the uid of the board of each stage, '' for one that was never reached."""
        return [stage["board"]["uid"] for stage in self.stages] or [self.board.uid]

    def read_clocks(self) -> ClockReading | None:
        """Return the present time on all clocks, None before the first status with a synchronised clock."""
        sample, now_s = self._clock_sample, self._clock.now_s()
        if sample is None:
            return None
        return ClockReading(sample[1] + (now_s - sample[0]), now_s, time.time())

    @property
    def round_trip_s(self) -> float:
        """Shortest recent round trip from the link process to the board, s, 0 before the first."""
        round_trip_ms: float | None = self.stats.get("round_trip_ms")
        return 0.0 if round_trip_ms is None else 1e-3 * round_trip_ms

    def board_s(self) -> float:
        """Return the present board time, s, or 0 before the first status with a synchronised clock."""
        sample = self._clock_sample
        return 0.0 if sample is None else sample[1] + (self._clock.now_s() - sample[0])

    def pop_clock_shift(self) -> float | None:
        """Return and clear the jump of the board's clock at a reconnection, s, None without a reconnection."""
        shift_s, self._clock_shift_s = self._clock_shift_s, None
        return shift_s
