"""Pass the batches of one plan through the limiter, and have the scheduler delay or pause where the limiter demands."""

from math import ceil, inf

import numpy as np

from optodrive.core.errors import OverBudgetError
from optodrive.core.types.plans import BudgetState, LimitedPlan, PulsePlan
from optodrive.core.types.push_options import Policy
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import compute_wait_s, galvo_feasible_prefix, limit
from optodrive.planning.planned_sequence import Delay, Shortfall
from optodrive.planning.scheduler.scheduler import GalvoPause, Scheduler

FIRST_PAUSE_FRACTION, PAUSE_FRACTION_MAX = 0.01, 0.1
"""Length of a plan's first galvo pause, and of the longest, as fractions of the time over which the mirrors'
acceleration is averaged. Each pause is twice as long as the one before: a newer frame of a stream leaves only the
beginning of a plan, which must not wait, and every pause costs planning time."""
COLD_AFTER_AVERAGING_TIMES = 50.0
"""Number of averaging times after which the mirrors' coils are cold."""


class BatchLimiter:
    """Limits the batches of a scheduler in order. `grant` is the callback of `Scheduler.run`.

    state: budget state after the batches granted so far
    delays: under policy "delay", every delay in order; galvo_pause_s: total of all pauses
    """

    def __init__(
        self, scheduler: Scheduler, budget: Budget, state: BudgetState, frame_count: int, policy: Policy = "trim"
    ) -> None:
        self.state = state
        self.delays: list[Delay] = []
        self.galvo_pause_s = 0.0
        self._pause_fraction = FIRST_PAUSE_FRACTION
        self._batch_pause_s, self._paused_row = 0.0, 0
        self._scheduler = scheduler
        self._budget = budget
        self._frame_count = frame_count
        self._policy = policy
        self._first_trimmed: tuple[PulsePlan, LimitedPlan, BudgetState] | None = None

    def grant(self, batch: PulsePlan) -> LimitedPlan | None:
        """Limit a batch. Return None after telling the scheduler to pause or delay it.

        Raises OverBudgetError under policy "refuse" for a pulse above a cap, and under "delay" for one that never fits.
        """
        # Before the limiter: it would trim a move's pulse to nothing, where a frame can be drawn more slowly.
        pause = self._find_galvo_pause(batch)
        if pause is not None:
            self._batch_pause_s, self._paused_row = self._batch_pause_s + pause.pause_us * 1e-6, pause.rows
            self._scheduler.pause(pause)
            return None
        try:
            granted, state = limit(batch, self.state, self._budget, self._policy)
        except OverBudgetError as error:
            if self._policy != "delay" or error.fits_after_s == inf:
                raise
            self.delays.append(Delay(int(batch.source[0]), error.pixel, error.cap, error.fits_after_s))
            self._scheduler.delay(ceil(error.fits_after_s * 1e6))
            # The batch comes again at a later time, when the mirrors' coils are colder: its pauses are found anew.
            self._forget_pauses()
            return None
        # Kept with the state before it: only that tells when the batch would have fit.
        if self._first_trimmed is None and granted.trimmed_j.any():
            self._first_trimmed = batch, granted, self.state
        self.state = state
        self.galvo_pause_s += self._batch_pause_s
        self._forget_pauses()
        return granted

    def _forget_pauses(self) -> None:
        """Begin a batch, which has no pauses yet."""
        self._batch_pause_s, self._paused_row = 0.0, 0

    def build_shortfall(self) -> Shortfall | None:
        """Describe the first trimmed pulse. Return None if no pulse was trimmed."""
        if self._first_trimmed is None:
            return None
        batch, granted, state = self._first_trimmed
        row = int(np.flatnonzero(granted.reason != "")[0])
        return Shortfall(
            pixel=int(batch.pixel[row]),
            cap=str(granted.reason[row]),
            margin_j=float(granted.trimmed_j[row]),
            fits_after_s=compute_wait_s(batch, state, self._budget),
        )

    def _find_galvo_pause(self, batch: PulsePlan) -> GalvoPause | None:
        """Return the pause that the mirrors need within a frame's batch. Return None if none is needed or none helps.

        No reduction of power makes a move feasible that exceeds the galvo cap, so a frame is drawn more slowly instead
        of with missing pulses. Trains keep their times and leave such pulses to the limiter.
        """
        row = galvo_feasible_prefix(batch, self.state, self._budget)
        if row == len(batch) or batch.source[row] >= self._frame_count:
            return None
        stage = int(batch.stage[row])
        averaging_s = float(self._budget.galvos.averaging_s[stage])
        cold_s = COLD_AFTER_AVERAGING_TIMES * averaging_s
        # A pause before this row was tried already: if not even cold coils admit the move, no longer pause will.
        if row == self._paused_row and galvo_feasible_prefix(batch, self.state, self._budget, row, cold_s) == row:
            return None
        pause_s = self._pause_fraction * averaging_s
        self._pause_fraction = min(2.0 * self._pause_fraction, PAUSE_FRACTION_MAX)
        return GalvoPause(row, stage, ceil(1e6 * pause_s))
