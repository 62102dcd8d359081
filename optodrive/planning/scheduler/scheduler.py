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
from optodrive.device.scan_field import AimedField
from optodrive.device.settling import MoveModel
from optodrive.physics.nominal_display import nothing
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import Heat
from optodrive.planning.scheduler.interleaving import (
    ROUNDS,
    Periods,
    Rehearsal,
    Together,
    best,
    joined,
    rested,
    simultaneity,
    slices,
)
from optodrive.planning.scheduler.train_pulses import TrainPulses
from optodrive.planning.scheduler.visiting_path import visiting_order

TRAIN_PIECE = 1000
"""Pulses of trains planned in one piece, unless told otherwise."""

TICK = 16
"""Pulses of a frame between two ticks."""

ALL = 2**60


class Rest(NamedTuple):
    """Of a piece only the first rows may stay as they are; then the mirrors rest for so long, µs."""

    rows: int
    us: int


Answer = int | Rest | None
Pieces = Generator[PulsePlan, Answer, None]
"""Yields pieces of a plan; takes how much later, µs, the last one must come, a rest, or None where it may stay."""


@dataclass(frozen=True)
class Machine:
    """What the scheduler knows of optics and laser. rest_s: dark time after which a pixel's next pulse counts anew."""

    layout: PixelLayout
    field: AimedField
    moves: MoveModel
    drive: DriveRange
    rest_s: float


@dataclass(frozen=True)
class Skipped:
    """A pixel that got no pulse from a frame or in a train's cycle: the heat left reaches its target by itself."""

    source: int
    pixel: int
    target_m: float


class _Row(NamedTuple):
    start_us: int
    width_us: int
    power_w: float
    pixel: int
    settle_us: int
    target_m: float
    nominal_us: int
    source: int


@dataclass
class _Cursor:
    """How far a plan has come. place: in the frame's order; waited_us: pauses put in so far.

    since_us, stay_us: when the gate first opened on the pixel `lit`, and how long the mirrors stayed there after that
    """

    free_us: int = 0
    lit: int | None = None
    since_us: int = 0
    stay_us: int = 0
    next_train: int = 0
    place: int = 0
    waited_us: int = 0
    skipped: int = 0


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
        machine: Machine,
        sequence: FrameSequence,
        at_rest: Callable[[], Heat],
        train_piece: int = TRAIN_PIECE,
        tick: Callable[[], None] = nothing,
        standing_on: int | None = None,
        orders: Mapping[int, IntArray] | None = None,
    ) -> None:
        self._machine = machine
        self._sequence = sequence
        self._train_piece = train_piece
        self._tick = tick
        self._orders = orders or {}
        x_rad, y_rad = machine.field.angles_rad(machine.layout.x_m, machine.layout.y_m)
        self._x_rad: list[float] = x_rad.tolist()
        self._y_rad: list[float] = y_rad.tolist()
        self._now = _Cursor(lit=standing_on)
        self._most = ALL
        self.lead_us = machine.moves.lead_us if standing_on is None else 0
        self.skipped: list[Skipped] = []
        self.together: list[Together] = []
        self._trains = TrainPulses(
            sequence.trains,
            len(sequence.frames),
            machine.drive,
            round(machine.rest_s * 1e6),
            self._move_us,
            at_rest,
            tick,
        )

    def pieces(self, heat: Heat) -> Pieces:
        """The plan in pieces; `heat`, on the plan's time line, must be brought up to date between them.

        What the limiter takes from one piece is thereby known to the next: no pulse counts on heat that never came. A
        piece that must come later is planned again for then, and all that follows comes as much later.
        """
        for source, frame in enumerate(self._sequence.frames):
            yield from self._trains_before(frame.show_at_s, heat)
            yield from self._frame(source, frame, heat)
        yield from self._trains_before(float("inf"), heat)

    def _offer(self, build: Callable[[], list[_Row]]) -> Generator[PulsePlan, Answer, bool]:
        """Yield what build makes, later or less of it as the answers ask; False where it makes nothing."""
        rest_us = 0
        while True:
            before = replace(self._now)
            rows = build()
            if not rows:
                return False
            answer = yield self._plan(rows)
            if not answer:
                self._now.free_us += rest_us
                self._most = ALL
                return True
            self._now = before
            del self.skipped[before.skipped :]
            if isinstance(answer, int):
                self._now.free_us += answer
                self._now.waited_us += answer
            elif answer.rows:
                self._most, rest_us = answer.rows, answer.us
            else:
                self._now.free_us += answer.us

    def _wanted_us(self, time_s: float) -> int:
        return self.lead_us + round(time_s * 1e6)

    def _move_us(self, origin: int | None, pixel: int, lit_us: int = 0) -> int:
        if origin is None:
            return self.lead_us
        return self._machine.moves.time_us(
            self._x_rad[pixel] - self._x_rad[origin], self._y_rad[pixel] - self._y_rad[origin], lit_us
        )

    def _order(self, frame: TactileFrame) -> list[int]:
        layout, driven = self._machine.layout, np.flatnonzero(frame.target_m > 0)
        mirrors = np.array(self._x_rad), np.array(self._y_rad)
        order: list[int] = visiting_order(driven, layout.row, layout.column, *mirrors, self._now.lit).tolist()
        return order

    def _place(self, pixel: int, width_us: int, power_w: float, wanted_us: int, target_m: float, source: int) -> _Row:
        now = self._now
        settle_us = self._move_us(now.lit, pixel, now.stay_us)
        start_us = max(wanted_us + now.waited_us, now.free_us + settle_us)
        if pixel != now.lit:
            now.since_us = start_us
        now.free_us, now.lit = start_us + width_us, pixel
        now.stay_us = now.free_us - now.since_us
        return _Row(start_us, width_us, power_w, pixel, settle_us, target_m, wanted_us, source)

    def _train_rows(self, heat: Heat) -> list[_Row]:
        """The next train pulse as a row, or none where it asks for a height that the heat there reaches by itself."""
        now, index = self._now, self._now.next_train
        pulse = self._trains[index]
        wanted_us = self.lead_us + pulse.nominal_us
        now.next_train += 1
        if not pulse.by_height:
            return [self._place(pulse.pixel, pulse.width_us, pulse.power_w, wanted_us, float("nan"), pulse.source)]
        start_us = max(wanted_us + now.waited_us, now.free_us + self._move_us(now.lit, pulse.pixel, now.stay_us))
        planned = self._trains.planned(index, heat, start_us, start_us - wanted_us - now.waited_us)
        target_m = self._trains.target_m(pulse.source)
        if planned is None:
            self.skipped.append(Skipped(pulse.source, pulse.pixel, target_m))
            now.skipped += 1
            return []
        return [self._place(pulse.pixel, *planned, wanted_us, target_m, pulse.source)]

    def _heat_is_known(self, rows: list[_Row]) -> bool:
        """Whether the next train pulse can be planned after rows that the limiter has not seen."""
        pulse = self._trains[self._now.next_train]
        return not pulse.by_height or all(row.pixel != pulse.pixel for row in rows)

    def _trains_before(self, until_s: float, heat: Heat) -> Pieces:
        def build() -> list[_Row]:
            rows: list[_Row] = []
            while self._now.next_train < len(self._trains) and len(rows) < self._train_piece:
                if self._trains[self._now.next_train].nominal_us >= until_s * 1e6:
                    break
                if not self._heat_is_known(rows):
                    break
                rows += self._train_rows(heat)
            return rows

        while (yield from self._offer(build)):
            pass

    def _train_is_due(self, end_us: int, pixel: int, lit_us: int) -> bool:
        """Whether the next train pulse would come late if the beam lit `pixel` for lit_us until end_us."""
        now = self._now
        if now.next_train >= len(self._trains):
            return False
        pulse = self._trains[now.next_train]
        due_us = self.lead_us + pulse.nominal_us + now.waited_us
        return due_us < end_us + self._move_us(pixel, pulse.pixel, lit_us)

    def _frame(self, source: int, frame: TactileFrame, heat: Heat) -> Pieces:
        """A frame's pulses, one a pixel, or several where its pixels shall stand up together."""
        order = self._orders[source].tolist() if source in self._orders else self._order(frame)
        if frame.together and len(order) > 1:
            yield from self._together(source, frame, order, heat)
        else:
            yield from self._round(source, frame, order, heat)

    def _together(self, source: int, frame: TactileFrame, order: list[int], heat: Heat) -> Pieces:
        """A frame in as many rounds as bring its pixels up together best, in the time it has."""
        drive, waited_us = self._machine.drive, self._now.waited_us
        begin_us = max(self._wanted_us(frame.show_at_s) + waited_us, self._now.free_us)
        single = {}
        for pixel in order:
            pulse = heat.pulse_for_peak(pixel, begin_us * 1e-6, float(frame.target_m[pixel]), drive)
            if pulse is not None:
                single[pixel] = pulse
        if not single:
            yield from self._round(source, frame, order, heat)
            return
        split = {rounds: shares for rounds in ROUNDS if (shares := slices(single, rounds)) is not None}
        rehearsals = [self._rehearsal(source, frame, order, heat, *item) for item in split.items()]
        due_us = self._wanted_us(frame.show_at_s + frame.duration_s) + waited_us
        chosen, unsplit = best(rehearsals, due_us * 1e-6), rehearsals[0]
        extra_s = chosen.end_s - unsplit.end_s
        self.together.append(Together(source, chosen.rounds, chosen.simultaneity, unsplit.simultaneity, extra_s))
        yield from self._rounds(source, frame, order, heat, chosen.rounds, split[chosen.rounds])

    def _rehearsal(
        self, source: int, frame: TactileFrame, order: list[int], heat: Heat, rounds: int, shares: Periods
    ) -> Rehearsal:
        """What a number of rounds would come to, on a copy of the heat; the plan stays where it is."""
        before, trial, pieces, last_round_s = replace(self._now), heat.copy(), [], 0.0
        for piece in self._rounds(source, frame, order, trial, rounds, shares):
            trial.pulses(piece.pixel, piece.start_s, piece.width_s, piece.power_w, self._tick)
            pieces.append(piece)
            if np.isfinite(piece.target_m[piece.source == source]).any() and last_round_s == 0.0:
                last_round_s = float(piece.start_s[0])
        self._now = before
        del self.skipped[before.skipped :]
        plan = joined(pieces)
        target_m = {pixel: float(frame.target_m[pixel]) for pixel in order}
        share = simultaneity(heat, plan, target_m, last_round_s, self._tick)
        end_s = float(plan.start_s[-1] + plan.width_s[-1])
        return Rehearsal(rounds, share, end_s, rounds == 1 or rested(plan, self._machine.rest_s))

    def _rounds(
        self, source: int, frame: TactileFrame, order: list[int], heat: Heat, rounds: int, shares: Periods
    ) -> Pieces:
        """Slices of so many PWM periods in every round but the last, in which each pixel gets what it still needs."""
        for _ in range(rounds - 1):
            yield from self._round(source, frame, [pixel for pixel in order if pixel in shares], heat, shares)
        yield from self._round(source, frame, order, heat)

    def _round(
        self, source: int, frame: TactileFrame, order: list[int], heat: Heat, shares: Periods | None = None
    ) -> Pieces:
        """One pulse a pixel, cut where a train's pulse comes between; to its height, or as wide as its share."""
        self._now.place = 0
        while (yield from self._offer(lambda: self._round_rows(source, frame, order, heat, shares))):
            pass

    def _round_rows(
        self, source: int, frame: TactileFrame, order: list[int], heat: Heat, shares: Periods | None
    ) -> list[_Row]:
        """The round's rows from where it stands, up to the next train pulse or its own end."""
        now, drive, wanted_us = self._now, self._machine.drive, self._wanted_us(frame.show_at_s)
        rows: list[_Row] = []
        while now.place < len(order) and len(rows) < self._most:
            pixel = order[now.place]
            target_m = float(frame.target_m[pixel])
            start_us = max(wanted_us + now.waited_us, now.free_us + self._move_us(now.lit, pixel, now.stay_us))
            if now.place % TICK == 0:
                self._tick()
            if shares is None:
                pulse = heat.pulse_for_peak(pixel, start_us * 1e-6, target_m, drive)
            else:
                pulse, target_m = (shares[pixel], 1.0), float("nan")
            if pulse is None:
                self.skipped.append(Skipped(source, pixel, target_m))
                now.skipped += 1
                now.place += 1
                continue
            width_us = round(pulse[0] * drive.period_s * 1e6)
            if self._train_is_due(start_us + width_us, pixel, width_us):
                if not self._heat_is_known(rows):
                    return rows
                rows += self._train_rows(heat)
                if rows:
                    return rows
                continue
            rows.append(self._place(pixel, width_us, pulse[1] * drive.max_power_w, wanted_us, target_m, source))
            now.place += 1
        return rows

    def _plan(self, rows: list[_Row]) -> PulsePlan:
        start_us, width_us, power_w, pixel, settle_us, target_m, nominal_us, source = zip(*rows, strict=True)
        index = np.array(pixel, dtype=np.int64)
        return PulsePlan(
            start_s=np.array(start_us) * 1e-6,
            width_s=np.array(width_us) * 1e-6,
            x_rad=np.array(self._x_rad)[index],
            y_rad=np.array(self._y_rad)[index],
            power_w=np.array(power_w),
            pixel=index,
            settle_s=np.array(settle_us) * 1e-6,
            target_m=np.array(target_m),
            nominal_s=np.array(nominal_us) * 1e-6,
            source=np.array(source, dtype=np.int64),
        )
