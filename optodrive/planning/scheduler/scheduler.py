"""Frames and trains onto one beam: when each pulse starts, and how strong it must be.

Trains keep their times; a frame's pulses fill the beam time between them. What is asked by height is planned from the
heat that is there. Times are whole microseconds inside.
"""

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import PulsePlan
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import PixelLayout
from optodrive.device.scan_field import ScanField
from optodrive.device.settling import SettlingTable
from optodrive.physics.nominal_display import ignore_progress
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.scheduler.interleaving import (
    ROUND_COUNTS,
    CandidateSchedule,
    PeriodsByPixel,
    SimultaneousFrame,
    compute_simultaneity,
    concatenate_batches,
    has_min_rest,
    select_schedule,
    split_pulses,
)
from optodrive.planning.scheduler.train_pulses import TrainPulses
from optodrive.planning.scheduler.visiting_path import compute_visiting_order

TRAIN_BATCH = 1000
"""Pulses of trains planned in one piece, unless told otherwise."""

PROGRESS_INTERVAL = 16
"""Pulses of a frame between two ticks."""

ALL = 2**60


class GalvoPause(NamedTuple):
    """Of a piece only the first rows may stay as they are; then the mirrors rest for so long, µs."""

    rows: int
    pause_us: int


Answer = int | GalvoPause | None
Pieces = Generator[PulsePlan, Answer, None]
"""Yields pieces of a plan; takes how much later, µs, the last one must come, a rest, or None where it may stay."""


@dataclass(frozen=True)
class ScanHead:
    """What the scheduler knows of optics and laser. rest_s: dark time after which a pixel's next pulse counts anew."""

    layout: PixelLayout
    field: ScanField
    settling: SettlingTable
    drive: DriveRange
    pulse_rest_s: float


@dataclass(frozen=True)
class SkippedPulse:
    """A pixel that got no pulse from a frame or in a train's cycle: the heat left reaches its target by itself."""

    source: int
    pixel: int
    target_m: float


class _PlannedPulse(NamedTuple):
    start_us: int
    width_us: int
    power_w: float
    pixel: int
    settling_us: int
    target_m: float
    requested_start_us: int
    source: int


@dataclass
class _Cursor:
    """How far a plan has come. place: in the frame's order; waited_us: pauses put in so far.

    since_us, stay_us: when the gate first opened on the pixel `lit`, and how long the mirrors stayed there after that
    """

    free_us: int = 0
    pixel: int | None = None
    arrival_us: int = 0
    dwell_us: int = 0
    next_train: int = 0
    position: int = 0
    delay_us: int = 0
    skipped_count: int = 0


class Scheduler:
    """Plans a sequence piece by piece, a frame and the train pulses beside it at a time.

    tick: called again and again while a frame is planned.
    at_rest: makes the display's heat before anybody lit it, for the cycles of trains that ask for heights.
    orders: by source, the order [k] in which a frame's driven pixels are visited; the others by a short path.
    standing_on: the pixel the mirrors stand on as the plan begins.
    lead_us: dark time before the sequence's zero, in which the mirrors come to the first pixel from wherever they are;
    none where it is known on which pixel they stand.
    skipped: pixels that needed no pulse, together: how frames were split that ask for it; both so far.
    Raises InputError for a train whose height or swing its cycles cannot have, or that leaves the beam no time.
    """

    def __init__(
        self,
        scan_head: ScanHead,
        sequence: FrameSequence,
        build_cold_heat: Callable[[], ThermalState],
        train_batch: int = TRAIN_BATCH,
        on_progress: Callable[[], None] = ignore_progress,
        initial_pixel: int | None = None,
        visiting_orders: Mapping[int, IntArray] | None = None,
    ) -> None:
        self._scan_head = scan_head
        self._sequence = sequence
        self._train_batch = train_batch
        self._on_progress = on_progress
        self._visiting_orders = visiting_orders or {}
        x_rad, y_rad = scan_head.field.angles_rad(scan_head.layout.x_m, scan_head.layout.y_m)
        self._x_rad: list[float] = x_rad.tolist()
        self._y_rad: list[float] = y_rad.tolist()
        self._cursor = _Cursor(pixel=initial_pixel)
        self._max_rows = ALL
        self.lead_in_us = scan_head.settling.lead_in_us if initial_pixel is None else 0
        self.skipped: list[SkippedPulse] = []
        self.simultaneous: list[SimultaneousFrame] = []
        self._trains = TrainPulses(
            sequence.trains,
            len(sequence.frames),
            scan_head.drive,
            round(scan_head.pulse_rest_s * 1e6),
            self._compute_settling_us,
            build_cold_heat,
            on_progress,
        )

    def pieces(self, heat: ThermalState) -> Pieces:
        """The plan in pieces; `heat`, on the plan's time line, must be brought up to date between them.

        What the limiter takes from one piece is thereby known to the next: no pulse counts on heat that never came. A
        piece that must come later is planned again for then, and all that follows comes as much later.
        """
        for source, frame in enumerate(self._sequence.frames):
            yield from self._trains_before(frame.show_at_s, heat)
            yield from self._frame(source, frame, heat)
        yield from self._trains_before(float("inf"), heat)

    def _offer(self, build: Callable[[], list[_PlannedPulse]]) -> Generator[PulsePlan, Answer, bool]:
        """Yield what build makes, later or less of it as the answers ask; False where it makes nothing."""
        rest_us = 0
        while True:
            before = replace(self._cursor)
            rows = build()
            if not rows:
                return False
            answer = yield self._build_plan(rows)
            if not answer:
                self._cursor.free_us += rest_us
                self._max_rows = ALL
                return True
            self._cursor = before
            del self.skipped[before.skipped_count :]
            if isinstance(answer, int):
                self._cursor.free_us += answer
                self._cursor.delay_us += answer
            elif answer.rows:
                self._max_rows, rest_us = answer.rows, answer.pause_us
            else:
                self._cursor.free_us += answer.pause_us

    def _compute_requested_us(self, time_s: float) -> int:
        return self.lead_in_us + round(time_s * 1e6)

    def _compute_settling_us(self, origin: int | None, pixel: int, dwell_us: int = 0) -> int:
        if origin is None:
            return self.lead_in_us
        return self._scan_head.settling.settling_us(
            self._x_rad[pixel] - self._x_rad[origin], self._y_rad[pixel] - self._y_rad[origin], dwell_us
        )

    def _compute_order(self, frame: TactileFrame) -> list[int]:
        layout, active = self._scan_head.layout, np.flatnonzero(frame.target_m > 0)
        mirrors = np.array(self._x_rad), np.array(self._y_rad)
        order: list[int] = compute_visiting_order(
            active, layout.row, layout.column, *mirrors, self._cursor.pixel
        ).tolist()
        return order

    def _place_pulse(
        self, pixel: int, width_us: int, power_w: float, requested_us: int, target_m: float, source: int
    ) -> _PlannedPulse:
        cursor = self._cursor
        settling_us = self._compute_settling_us(cursor.pixel, pixel, cursor.dwell_us)
        start_us = max(requested_us + cursor.delay_us, cursor.free_us + settling_us)
        if pixel != cursor.pixel:
            cursor.arrival_us = start_us
        cursor.free_us, cursor.pixel = start_us + width_us, pixel
        cursor.dwell_us = cursor.free_us - cursor.arrival_us
        return _PlannedPulse(start_us, width_us, power_w, pixel, settling_us, target_m, requested_us, source)

    def _build_train_rows(self, heat: ThermalState) -> list[_PlannedPulse]:
        """The next train pulse as a row, or none where it asks for a height that the heat there reaches by itself."""
        cursor, index = self._cursor, self._cursor.next_train
        pulse = self._trains[index]
        requested_us = self.lead_in_us + pulse.requested_start_us
        cursor.next_train += 1
        if not pulse.is_by_height:
            return [
                self._place_pulse(pulse.pixel, pulse.width_us, pulse.power_w, requested_us, float("nan"), pulse.source)
            ]
        start_us = max(
            requested_us + cursor.delay_us,
            cursor.free_us + self._compute_settling_us(cursor.pixel, pulse.pixel, cursor.dwell_us),
        )
        planned = self._trains.plan_pulse(index, heat, start_us, start_us - requested_us - cursor.delay_us)
        target_m = self._trains.get_target_m(pulse.source)
        if planned is None:
            self.skipped.append(SkippedPulse(pulse.source, pulse.pixel, target_m))
            cursor.skipped_count += 1
            return []
        return [self._place_pulse(pulse.pixel, *planned, requested_us, target_m, pulse.source)]

    def _is_heat_known(self, rows: list[_PlannedPulse]) -> bool:
        """Whether the next train pulse can be planned after rows that the limiter has not seen."""
        pulse = self._trains[self._cursor.next_train]
        return not pulse.is_by_height or all(row.pixel != pulse.pixel for row in rows)

    def _trains_before(self, until_s: float, heat: ThermalState) -> Pieces:
        def build() -> list[_PlannedPulse]:
            rows: list[_PlannedPulse] = []
            while self._cursor.next_train < len(self._trains) and len(rows) < self._train_batch:
                if self._trains[self._cursor.next_train].requested_start_us >= until_s * 1e6:
                    break
                if not self._is_heat_known(rows):
                    break
                rows += self._build_train_rows(heat)
            return rows

        while (yield from self._offer(build)):
            pass

    def _is_train_due(self, end_us: int, pixel: int, dwell_us: int) -> bool:
        """Whether the next train pulse would come late if the beam lit `pixel` for lit_us until end_us."""
        cursor = self._cursor
        if cursor.next_train >= len(self._trains):
            return False
        pulse = self._trains[cursor.next_train]
        deadline_us = self.lead_in_us + pulse.requested_start_us + cursor.delay_us
        return deadline_us < end_us + self._compute_settling_us(pixel, pulse.pixel, dwell_us)

    def _frame(self, source: int, frame: TactileFrame, heat: ThermalState) -> Pieces:
        """A frame's pulses, one a pixel, or several where its pixels shall stand up together."""
        order = (
            self._visiting_orders[source].tolist() if source in self._visiting_orders else self._compute_order(frame)
        )
        if frame.simultaneous and len(order) > 1:
            yield from self._together(source, frame, order, heat)
        else:
            yield from self._round(source, frame, order, heat)

    def _together(self, source: int, frame: TactileFrame, order: list[int], heat: ThermalState) -> Pieces:
        """A frame in as many rounds as bring its pixels up together best, in the time it has."""
        drive, waited_us = self._scan_head.drive, self._cursor.delay_us
        begin_us = max(self._compute_requested_us(frame.show_at_s) + waited_us, self._cursor.free_us)
        single = {}
        for pixel in order:
            pulse = heat.solve_pulse(pixel, begin_us * 1e-6, float(frame.target_m[pixel]), drive)
            if pulse is not None:
                single[pixel] = pulse
        if not single:
            yield from self._round(source, frame, order, heat)
            return
        split = {rounds: shares for rounds in ROUND_COUNTS if (shares := split_pulses(single, rounds)) is not None}
        rehearsals = [self._rehearsal(source, frame, order, heat, *item) for item in split.items()]
        due_us = self._compute_requested_us(frame.show_at_s + frame.duration_s) + waited_us
        chosen, unsplit = select_schedule(rehearsals, due_us * 1e-6), rehearsals[0]
        extra_s = chosen.end_s - unsplit.end_s
        self.simultaneous.append(
            SimultaneousFrame(source, chosen.rounds, chosen.simultaneity, unsplit.simultaneity, extra_s)
        )
        yield from self._rounds(source, frame, order, heat, chosen.rounds, split[chosen.rounds])

    def _rehearsal(
        self,
        source: int,
        frame: TactileFrame,
        order: list[int],
        heat: ThermalState,
        rounds: int,
        shares: PeriodsByPixel,
    ) -> CandidateSchedule:
        """What a number of rounds would come to, on a copy of the heat; the plan stays where it is."""
        before, trial, pieces, last_round_s = replace(self._cursor), heat.copy(), [], 0.0
        for piece in self._rounds(source, frame, order, trial, rounds, shares):
            trial.apply_pulses(piece.pixel, piece.start_s, piece.width_s, piece.power_w, self._on_progress)
            pieces.append(piece)
            if np.isfinite(piece.target_m[piece.source == source]).any() and last_round_s == 0.0:
                last_round_s = float(piece.start_s[0])
        self._cursor = before
        del self.skipped[before.skipped_count :]
        plan = concatenate_batches(pieces)
        target_m = {pixel: float(frame.target_m[pixel]) for pixel in order}
        share = compute_simultaneity(heat, plan, target_m, last_round_s, self._on_progress)
        end_s = float(plan.start_s[-1] + plan.width_s[-1])
        return CandidateSchedule(rounds, share, end_s, rounds == 1 or has_min_rest(plan, self._scan_head.pulse_rest_s))

    def _rounds(
        self,
        source: int,
        frame: TactileFrame,
        order: list[int],
        heat: ThermalState,
        rounds: int,
        shares: PeriodsByPixel,
    ) -> Pieces:
        """Slices of so many PWM periods in every round but the last, in which each pixel gets what it still needs."""
        for _ in range(rounds - 1):
            yield from self._round(source, frame, [pixel for pixel in order if pixel in shares], heat, shares)
        yield from self._round(source, frame, order, heat)

    def _round(
        self,
        source: int,
        frame: TactileFrame,
        order: list[int],
        heat: ThermalState,
        shares: PeriodsByPixel | None = None,
    ) -> Pieces:
        """One pulse a pixel, cut where a train's pulse comes between; to its height, or as wide as its share."""
        self._cursor.position = 0
        while (yield from self._offer(lambda: self._round_rows(source, frame, order, heat, shares))):
            pass

    def _round_rows(
        self, source: int, frame: TactileFrame, order: list[int], heat: ThermalState, shares: PeriodsByPixel | None
    ) -> list[_PlannedPulse]:
        """The round's rows from where it stands, up to the next train pulse or its own end."""
        cursor, drive, requested_us = self._cursor, self._scan_head.drive, self._compute_requested_us(frame.show_at_s)
        rows: list[_PlannedPulse] = []
        while cursor.position < len(order) and len(rows) < self._max_rows:
            pixel = order[cursor.position]
            target_m = float(frame.target_m[pixel])
            start_us = max(
                requested_us + cursor.delay_us,
                cursor.free_us + self._compute_settling_us(cursor.pixel, pixel, cursor.dwell_us),
            )
            if cursor.position % PROGRESS_INTERVAL == 0:
                self._on_progress()
            if shares is None:
                pulse = heat.solve_pulse(pixel, start_us * 1e-6, target_m, drive)
            else:
                pulse, target_m = (shares[pixel], 1.0), float("nan")
            if pulse is None:
                self.skipped.append(SkippedPulse(source, pixel, target_m))
                cursor.skipped_count += 1
                cursor.position += 1
                continue
            width_us = round(pulse[0] * drive.period_s * 1e6)
            if self._is_train_due(start_us + width_us, pixel, width_us):
                if not self._is_heat_known(rows):
                    return rows
                rows += self._build_train_rows(heat)
                if rows:
                    return rows
                continue
            rows.append(
                self._place_pulse(pixel, width_us, pulse[1] * drive.max_power_w, requested_us, target_m, source)
            )
            cursor.position += 1
        return rows

    def _build_plan(self, rows: list[_PlannedPulse]) -> PulsePlan:
        start_us, width_us, power_w, pixel, settling_us, target_m, requested_start_us, source = zip(*rows, strict=True)
        index = np.array(pixel, dtype=np.int64)
        return PulsePlan(
            start_s=np.array(start_us) * 1e-6,
            width_s=np.array(width_us) * 1e-6,
            x_rad=np.array(self._x_rad)[index],
            y_rad=np.array(self._y_rad)[index],
            power_w=np.array(power_w),
            pixel=index,
            settling_s=np.array(settling_us) * 1e-6,
            target_m=np.array(target_m),
            requested_start_s=np.array(requested_start_us) * 1e-6,
            source=np.array(source, dtype=np.int64),
        )
