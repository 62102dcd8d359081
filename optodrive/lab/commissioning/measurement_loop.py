"""The closed loop: measure where it tells most, fit, until the field is sure enough.

Whoever looks, a sensor or a person, says where the beam may be sent next and what came of it; the rest is the same.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import NotReadyError, RefusedError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.units import m_to_um
from optodrive.lab.calibration.field_fit import FieldFit, fit_field
from optodrive.lab.calibration.field_prior import FieldPrior
from optodrive.lab.calibration.next_spot import select_next_spot
from optodrive.lab.calibration.spot_checks import check_fit, check_spots
from optodrive.lab.calibration.spots import MeasuredSpots
from optodrive.lab.commissioning.exclusive_board import HeldBoard
from optodrive.lab.commissioning.predicted_error import predicted_rms_m
from optodrive.lab.commissioning.session_file import Row, SessionFile, save
from optodrive.lab.commissioning.worker_process import Aside

ASIDE_MAX_S = 30.0
"""What takes longer has gone wrong; the board is not kept armed for it."""
UNSEEN_MAX = 3
"""So many places one after another without a spot, and nothing is seen at all."""
BELIEVED = 20
"""With fewer spots a fit knows its own noise and surface too little to be believed that it is good."""
SURE = 1.3
"""What comes out is itself uncertain: nine times in ten it is less than this times the prediction."""


AGAIN = 2
"""An interrupted calibration begins by so many of its spots at the most."""
MOVED = 5.0
"""Spots so many sigmas apart, measured twice, are not the same."""


class Look(Protocol):
    """What finds a spot."""

    @property
    def name(self) -> str:
        """Who looks."""

    @property
    def unseen(self) -> str:
        """What is told when it finds none: value and expectation."""

    def candidates(self, fit: FieldFit) -> FloatArray:
        """Codes to which the beam might be sent, [k, 2]; the same k, in the same order, every time."""

    def start(self) -> list[int]:
        """Candidates to begin with: corners, edges and the middle."""

    def places(self, spots: MeasuredSpots) -> IntArray:
        """Which candidate each spot is of, -1 for none, [n]."""

    def measure(self, place: int, x_code: int, y_code: int) -> Row | None:
        """Send the beam to a candidate and say where it landed; None where nothing is seen."""


@dataclass(frozen=True)
class Progress:
    """After a spot: how many there are, and the field's predicted error over the display, rms of its length.

    sure_m: what that is nine times in ten less than
    """

    spots: int
    predicted_m: float
    sure_m: float
    outliers: int


@dataclass(frozen=True)
class Measured:
    """What came of it: the fit, its predicted error, and whether it is surely as small as asked for."""

    fit: FieldFit
    predicted_m: float
    sure_m: float
    goal_reached: bool


def fitted(spots: MeasuredSpots, prior: FieldPrior) -> FieldFit:
    """As `fit_field`, and ready to be asked for codes: what that takes once would cost the lease."""
    fit = fit_field(spots, prior)
    fit.field.codes(np.zeros(1), np.zeros(1))
    return fit


class Measuring:
    """One calibration on a held, armed board. Raises what ends it; every spot so far is in the session."""

    def __init__(
        self,
        held: HeldBoard,
        look: Look,
        session: SessionFile,
        aside: Aside,
        clock: Clock,
        goal_m: float,
        spots_max: int,
    ) -> None:
        self._held, self._look, self._session, self._aside, self._clock = held, look, session, aside, clock
        self._goal_m, self._spots_max = goal_m, spots_max
        self._prior = FieldPrior.from_config(held.config)
        self._unseen: set[int] = set()

    def run(self, tell: Callable[[Progress], None]) -> Measured:
        """Measure until sure enough, or until there are spots_max; telling after each spot.

        Spots of an interrupted session are gone on with only where the first of them still lies where it did.
        """
        if self._session.rows:
            self._check_still_there()
        while True:
            fit: FieldFit = self._meanwhile(fitted, self._session.spots, self._prior)
            predicted_m: float = self._meanwhile(predicted_rms_m, fit, self._held.config)
            count, sure_m = len(self._session.rows), SURE * predicted_m
            tell(Progress(count, predicted_m, sure_m, int(fit.outlier.sum())))
            if not self._to_begin_with():
                self._meanwhile(check_spots, f"calibrate: {self._look.name}", self._session.spots, self._prior)
                if (sure_m <= self._goal_m and count >= BELIEVED) or count >= self._spots_max:
                    self._meanwhile(check_fit, f"calibrate: {self._look.name}", fit)
                    return Measured(fit, predicted_m, sure_m, sure_m <= self._goal_m)
            self._one_more(fit)

    def _meanwhile(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Have it done aside, the lease kept."""
        self._aside.begin(function, *arguments)
        until_s = self._clock.now_s() + ASIDE_MAX_S
        while not self._aside.ready():
            self._held.step()
            if self._clock.now_s() > until_s:
                raise NotReadyError(f"{function.__name__} of {len(self._session.rows)} spots takes {ASIDE_MAX_S:g} s")
        return self._aside.result()

    def _check_still_there(self) -> None:
        """Measure the first good spot again, and where that is off the second: one alone may be false."""
        spots = self._session.spots
        fit: FieldFit = self._meanwhile(fitted, spots, self._prior)
        places, most_m = self._look.places(spots), MOVED * 2.0**0.5 * fit.noise_m
        code_m = 2.0 * self._prior.focal_length_m * self._prior.rad_per_code
        off_um = []
        for index in np.flatnonzero(~fit.outlier & (places >= 0))[:AGAIN]:
            before = self._session.rows[index]
            now = self._look.measure(int(places[index]), int(before.x_code), int(before.y_code))
            if now is None:
                off_um.append("nowhere")
                continue
            x_m = now.x_m - before.x_m - code_m * (now.x_code - before.x_code)
            y_m = now.y_m - before.y_m - code_m * (now.y_code - before.y_code)
            if np.hypot(x_m, y_m) <= most_m:
                return
            off_um.append(f"{m_to_um(float(np.hypot(x_m, y_m))):.0f} µm off")
        if off_um:
            raise RefusedError(
                f"calibrate: the display or the optics moved since: the spots measured first are now seen "
                f"{' and '.join(off_um)}, expected at most {m_to_um(most_m):.0f} µm; "
                f"delete {self._session.path} to begin anew"
            )

    def _one_more(self, fit: FieldFit) -> None:
        """Measure one more spot; a place where none is seen is given up for another."""
        in_a_row = 0
        while True:
            codes = np.rint(self._look.candidates(fit))
            place = self._chosen(fit, codes)
            row = self._look.measure(place, int(codes[place, 0]), int(codes[place, 1]))
            if row is not None:
                self._session.rows.append(row)
                self._meanwhile(save, self._session.path, self._session.text())
                return
            self._unseen.add(place)
            in_a_row += 1
            if in_a_row == UNSEEN_MAX:
                raise RefusedError(f"calibrate: {UNSEEN_MAX} places one after another: {self._look.unseen}")

    def _to_begin_with(self) -> list[int]:
        """What is left of the places to begin with."""
        done = {*self._look.places(self._session.spots).tolist(), *self._unseen}
        return [place for place in self._look.start() if place not in done]

    def _chosen(self, fit: FieldFit, codes: FloatArray) -> int:
        """What to begin with first, then what tells most; never where a good spot is already, or none was seen."""
        begin = self._to_begin_with()
        if begin:
            return begin[0]
        done = {*self._look.places(fit.spots)[~fit.outlier].tolist(), *self._unseen}
        free = [place for place in range(len(codes)) if place not in done]
        if not free:
            raise RefusedError(
                f"calibrate: all {len(codes)} places are measured, expected more of them or a lesser goal"
            )
        row: int = self._meanwhile(select_next_spot, fit, codes[free])
        return free[row]
