"""A whole sweep of pixel calibration under one arming: every aim and every pixel, each pulse in the journal at once."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields

from optodrive.core.errors import RefusedError
from optodrive.core.types.plans import LimitedPlan, PulsePlan
from optodrive.core.types.stimuli import FrameSequence
from optodrive.lab.calibration.pixel_sweep import Aim, SweepJournal, SweepPulse, build_sweep, is_reachable
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.link.protocol.quantisation import DUTY_MAX
from optodrive.link.session.plan_job import PlanJob
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence

PULSES_PER_JOB = 128
"""Pulses that are limited and verified at once: this takes a few milliseconds, in which the lease is not renewed."""


@dataclass(frozen=True, eq=False)
class AimPlan:
    """The pulses of one aim, planned for a cold display."""

    aim: Aim
    plan: LimitedPlan


def plan_aims(displays: list[tuple[Aim, DisplayModel]], journal: SweepJournal) -> list[AimPlan]:
    """Plan the pulses that the journal lacks, of the pixels at which the mirrors reach the aim.

    displays: for each aim, the display with its pixel map. Raises RefusedError if a pulse never fits the caps.
    """
    plans = []
    for aim, display in displays:
        missing = is_reachable(display.config, display.scan_head.field, aim)
        # What an interrupted sweep has played is not lit again.
        missing[list(journal.list_done(aim.name))] = False
        trains = build_sweep(display.config, aim, missing)
        if trains:
            sequence = FrameSequence((), trains)
            # Never trimmed: a pulse of another energy would be another measurement.
            plan = plan_sequence(display, sequence, *display.build_cold_state(), policy="delay").plan
            plans.append(AimPlan(aim, plan))
    return plans


def play_aims(
    plans: list[AimPlan],
    board: ExclusiveBoard,
    journal: SweepJournal,
    rest_s: float,
    on_progress: Callable[[AimPlan, int], None],
) -> None:
    """Play all plans on the armed board, with a rest between them in which the display cools.

    on_progress: called with the plan and its number of executed pulses. Raises InputError if the journal cannot be
    written; errors of the board as ExclusiveBoard.
    """
    for number, item in enumerate(plans):
        if number:
            # Each aim is planned for a cold display.
            board.wait(rest_s)
        recorder = _JournalRecorder(item, board, journal, on_progress)
        for first in range(0, len(item.plan), PULSES_PER_JOB):
            recorder.first = recorder.count = first
            board.play(_cut_plan(item.plan, first), recorder.record)
        # A write of the journal's thread may have failed since the last append.
        journal.raise_if_failed()
        if recorder.count != len(item.plan):
            raise RefusedError(f"sweep: aim {item.aim.name}: {recorder.count} of {len(item.plan)} pulses were reported")


def _cut_plan(plan: LimitedPlan, first: int) -> PulsePlan:
    """Return up to PULSES_PER_JOB pulses from `first` on, with the lead-in of the whole plan."""
    rows = slice(first, first + PULSES_PER_JOB)
    columns = {item.name: getattr(plan, item.name)[rows].copy() for item in fields(PulsePlan)}
    shift_s = float(plan.start_s[first] - plan.start_s[0])
    columns["start_s"] -= shift_s
    columns["requested_start_s"] -= shift_s
    return PulsePlan(**columns)


@dataclass
class _JournalRecorder:
    """Copies the reported pulses of one aim to the journal.

    first: row of the plan with which the present job begins; count: number of pulses copied
    """

    item: AimPlan
    board: ExclusiveBoard
    journal: SweepJournal
    on_progress: Callable[[AimPlan, int], None]
    first: int = 0
    count: int = 0

    def record(self, job: PlanJob) -> None:
        """Append the pulses reported since the last call."""
        scale, plan = self.board.session.scale, self.item.plan
        done = job.executed_count
        reported = job.read_reported(self.count - self.first, done)
        # At each report, so that the drift of the board's clock does not add up over a sweep.
        unix_minus_board_s = time.time() - self.board.session.board_s()
        self.journal.append(
            [
                SweepPulse(
                    self.item.aim.name,
                    int(plan.pixel[self.first + row]),
                    round(unix_minus_board_s + on_tick * scale.tick_s, 6),
                    round(on_tick * scale.tick_s, 6),
                    round(on_ticks * scale.tick_s, 6),
                    round(power_w, 9),
                )
                for row, on_tick, on_ticks, power_w in zip(
                    *(column.tolist() for column in reported[:3]),
                    scale.to_power_w(reported.duty / DUTY_MAX).tolist(),
                    strict=True,
                )
            ]
        )
        self.count = self.first + done
        self.on_progress(self.item, self.count)
