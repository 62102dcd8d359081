"""Frames and trains onto one beam: when each pulse starts, and how strong it must be.

Trains keep their times; a frame's pulses fill the beam time between them. Times are whole microseconds inside.
"""

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from optodrive.config import PixelLayout
from optodrive.flow import FrameSequence, IntArray, PulsePlan, PulseTrain, TactileFrame
from optodrive.physics.array import nothing
from optodrive.physics.drive import DriveRange
from optodrive.physics.heat import Heat
from optodrive.plan.field import IdealField
from optodrive.plan.galvo import MoveModel
from optodrive.plan.order import visiting_order

TRAIN_PIECE = 1000
"""Pulses of trains planned in one piece, unless told otherwise."""

TICK = 16
"""Pulses of a frame between two ticks."""

Pieces = Generator[PulsePlan, int | None, None]
"""Yields pieces of a plan; takes how much later, µs, the last one must come, or None where it may stay."""


@dataclass(frozen=True)
class Machine:
    """What the scheduler knows of optics and laser."""

    layout: PixelLayout
    field: IdealField
    moves: MoveModel
    drive: DriveRange


@dataclass(frozen=True)
class Skipped:
    """A pixel that got no pulse: the heat left there reaches its target by itself."""

    source: int
    pixel: int
    target_m: float


class _TrainPulse(NamedTuple):
    nominal_us: int
    source: int
    pixel: int
    width_us: int
    power_w: float


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
    """How far a plan has come. place: in the frame's order; waited_us: pauses put in so far."""

    free_us: int = 0
    lit: int | None = None
    next_train: int = 0
    place: int = 0
    waited_us: int = 0
    skipped: int = 0


class Scheduler:
    """Plans a sequence piece by piece, a frame and the train pulses beside it at a time.

    tick: called again and again while a frame is planned.
    orders: by source, the order [k] in which a frame's driven pixels are visited; the others by a short path.
    lead_us: dark time before the sequence's zero, in which the mirrors come to the first pixel from wherever they are.
    skipped: pixels that needed no pulse, so far.
    """

    def __init__(
        self,
        machine: Machine,
        sequence: FrameSequence,
        train_piece: int = TRAIN_PIECE,
        tick: Callable[[], None] = nothing,
        orders: Mapping[int, IntArray] | None = None,
    ) -> None:
        self._machine = machine
        self._sequence = sequence
        self._train_piece = train_piece
        self._tick = tick
        self._orders = orders or {}
        self._x_rad: list[float] = machine.field.mirror_rad(machine.layout.x_m).tolist()
        self._y_rad: list[float] = machine.field.mirror_rad(machine.layout.y_m).tolist()
        self._trains = _train_pulses(sequence.trains, len(sequence.frames))
        self._now = _Cursor()
        self.lead_us = machine.moves.time_us(max(self._x_rad) - min(self._x_rad), max(self._y_rad) - min(self._y_rad))
        self.skipped: list[Skipped] = []

    def pieces(self, heat: Heat) -> Pieces:
        """The plan in pieces; `heat`, on the plan's time line, must be brought up to date between them.

        What the limiter takes from one piece is thereby known to the next: no pulse counts on heat that never came. A
        piece that must come later is planned again for then, and all that follows comes as much later.
        """
        for source, frame in enumerate(self._sequence.frames):
            yield from self._trains_before(frame.show_at_s)
            yield from self._frame(source, frame, heat)
        yield from self._trains_before(float("inf"))

    def _offer(self, build: Callable[[], list[_Row]]) -> Generator[PulsePlan, int | None, bool]:
        """Yield what build makes, later and later as the answers ask; False where it makes nothing."""
        while True:
            before = replace(self._now)
            rows = build()
            if not rows:
                return False
            wait_us = yield self._plan(rows)
            if not wait_us:
                return True
            self._now = before
            self._now.free_us += wait_us
            self._now.waited_us += wait_us
            del self.skipped[before.skipped :]

    def _wanted_us(self, time_s: float) -> int:
        return self.lead_us + round(time_s * 1e6)

    def _move_us(self, origin: int | None, pixel: int) -> int:
        if origin is None:
            return self.lead_us
        return self._machine.moves.time_us(
            self._x_rad[pixel] - self._x_rad[origin], self._y_rad[pixel] - self._y_rad[origin]
        )

    def _order(self, frame: TactileFrame) -> list[int]:
        layout, driven = self._machine.layout, np.flatnonzero(frame.target_m > 0)
        mirrors = np.array(self._x_rad), np.array(self._y_rad)
        order: list[int] = visiting_order(driven, layout.row, layout.column, *mirrors, self._now.lit).tolist()
        return order

    def _place(self, pixel: int, width_us: int, power_w: float, wanted_us: int, target_m: float, source: int) -> _Row:
        now = self._now
        settle_us = self._move_us(now.lit, pixel)
        start_us = max(wanted_us + now.waited_us, now.free_us + settle_us)
        now.free_us, now.lit = start_us + width_us, pixel
        return _Row(start_us, width_us, power_w, pixel, settle_us, target_m, wanted_us, source)

    def _train_row(self) -> _Row:
        pulse = self._trains[self._now.next_train]
        self._now.next_train += 1
        wanted_us = self.lead_us + pulse.nominal_us
        return self._place(pulse.pixel, pulse.width_us, pulse.power_w, wanted_us, float("nan"), pulse.source)

    def _trains_before(self, until_s: float) -> Pieces:
        def build() -> list[_Row]:
            rows: list[_Row] = []
            while self._now.next_train < len(self._trains) and len(rows) < self._train_piece:
                if self._trains[self._now.next_train].nominal_us >= until_s * 1e6:
                    break
                rows.append(self._train_row())
            return rows

        while (yield from self._offer(build)):
            pass

    def _train_is_due(self, end_us: int, pixel: int) -> bool:
        """Whether the next train pulse would come late if the beam stayed on `pixel` until end_us."""
        now = self._now
        if now.next_train >= len(self._trains):
            return False
        pulse = self._trains[now.next_train]
        due_us = self.lead_us + pulse.nominal_us + now.waited_us
        return due_us < end_us + self._move_us(pixel, pulse.pixel)

    def _frame(self, source: int, frame: TactileFrame, heat: Heat) -> Pieces:
        """A frame's pulses, one a pixel, cut where a train's pulse comes between."""
        order = self._orders[source].tolist() if source in self._orders else self._order(frame)
        self._now.place = 0
        while (yield from self._offer(lambda: self._frame_rows(source, frame, order, heat))):
            pass

    def _frame_rows(self, source: int, frame: TactileFrame, order: list[int], heat: Heat) -> list[_Row]:
        """The frame's rows from where it stands, up to the next train pulse or its own end."""
        now, drive, wanted_us = self._now, self._machine.drive, self._wanted_us(frame.show_at_s)
        rows: list[_Row] = []
        while now.place < len(order):
            pixel = order[now.place]
            target_m = float(frame.target_m[pixel])
            start_us = max(wanted_us + now.waited_us, now.free_us + self._move_us(now.lit, pixel))
            if now.place % TICK == 0:
                self._tick()
            pulse = heat.pulse_for_peak(pixel, start_us * 1e-6, target_m, drive)
            if pulse is None:
                self.skipped.append(Skipped(source, pixel, target_m))
                now.skipped += 1
                now.place += 1
                continue
            width_us = round(pulse[0] * drive.period_s * 1e6)
            if self._train_is_due(start_us + width_us, pixel):
                return [*rows, self._train_row()]
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


def _train_pulses(trains: tuple[PulseTrain, ...], first_source: int) -> list[_TrainPulse]:
    pulses = [
        _TrainPulse(
            round(start_s * 1e6), first_source + k, train.pixel, round(train.pulse_width_s * 1e6), train.power_w
        )
        for k, train in enumerate(trains)
        for start_s in train.pulse_starts_s()
    ]
    return sorted(pulses)
