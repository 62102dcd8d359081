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
from optodrive.lab.commissioning.calibration_session import CalibrationSession, SpotRow, save_text
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.lab.commissioning.predicted_error import predicted_rms_m
from optodrive.lab.commissioning.worker_process import WorkerProcess

WORKER_TIMEOUT_S = 30.0
"""What takes longer has gone wrong; the board is not kept armed for it."""
CONSECUTIVE_MISSES_MAX = 3
"""So many places one after another without a spot, and nothing is seen at all."""
SPOTS_MIN = 20
"""With fewer spots a fit knows its own noise and surface too little to be believed that it is good."""
CONFIDENCE_FACTOR = 1.3
"""What comes out is itself uncertain: nine times in ten it is less than this times the prediction."""


RECHECKS_MAX = 2
"""An interrupted calibration begins by so many of its spots at the most."""
RECHECK_SIGMAS = 5.0
"""Spots so many sigmas apart, measured twice, are not the same."""


class SpotLocator(Protocol):
    """What finds a spot."""

    @property
    def name(self) -> str:
        """Who looks."""

    @property
    def not_found_message(self) -> str:
        """What is told when it finds none: value and expectation."""

    def candidate_codes(self, fit: FieldFit) -> FloatArray:
        """Codes to which the beam might be sent, [k, 2]; the same k, in the same order, every time."""

    def initial_places(self) -> list[int]:
        """Candidates to begin with: corners, edges and the middle."""

    def match_places(self, spots: MeasuredSpots) -> IntArray:
        """Which candidate each spot is of, -1 for none, [n]."""

    def measure(self, place: int, x_code: int, y_code: int) -> SpotRow | None:
        """Send the beam to a candidate and say where it landed; None where nothing is seen."""


@dataclass(frozen=True)
class MeasurementProgress:
    """After a spot: how many there are, and the field's predicted error over the display, rms of its length.

    sure_m: what that is nine times in ten less than
    """

    spots: int
    predicted_error_m: float
    error_bound_m: float
    outliers: int


@dataclass(frozen=True)
class MeasurementResult:
    """What came of it: the fit, its predicted error, and whether it is surely as small as asked for."""

    fit: FieldFit
    predicted_error_m: float
    error_bound_m: float
    target_reached: bool


def fit_and_warm_up(spots: MeasuredSpots, prior: FieldPrior) -> FieldFit:
    """As `fit_field`, and ready to be asked for codes: what that takes once would cost the lease."""
    fit = fit_field(spots, prior)
    fit.field.codes(np.zeros(1), np.zeros(1))
    return fit


class MeasurementLoop:
    """One calibration on a held, armed board. Raises what ends it; every spot so far is in the session."""

    def __init__(
        self,
        board: ExclusiveBoard,
        locator: SpotLocator,
        session: CalibrationSession,
        worker: WorkerProcess,
        clock: Clock,
        target_error_m: float,
        spots_max: int,
    ) -> None:
        self._board, self._locator, self._session, self._worker, self._clock = board, locator, session, worker, clock
        self._target_error_m, self._spots_max = target_error_m, spots_max
        self._prior = FieldPrior.from_config(board.config)
        self._unseen_places: set[int] = set()

    def run(self, on_progress: Callable[[MeasurementProgress], None]) -> MeasurementResult:
        """Measure until sure enough, or until there are spots_max; telling after each spot.

        Spots of an interrupted session are gone on with only where the first of them still lies where it did.
        """
        if self._session.rows:
            self._check_unchanged()
        while True:
            fit: FieldFit = self._run_keeping_lease(fit_and_warm_up, self._session.spots, self._prior)
            predicted_error_m: float = self._run_keeping_lease(predicted_rms_m, fit, self._board.config)
            count, error_bound_m = len(self._session.rows), CONFIDENCE_FACTOR * predicted_error_m
            on_progress(MeasurementProgress(count, predicted_error_m, error_bound_m, int(fit.outlier.sum())))
            if not self._remaining_initial_places():
                self._run_keeping_lease(
                    check_spots, f"calibrate: {self._locator.name}", self._session.spots, self._prior
                )
                if (error_bound_m <= self._target_error_m and count >= SPOTS_MIN) or count >= self._spots_max:
                    self._run_keeping_lease(check_fit, f"calibrate: {self._locator.name}", fit)
                    return MeasurementResult(
                        fit, predicted_error_m, error_bound_m, error_bound_m <= self._target_error_m
                    )
            self._measure_next(fit)

    def _run_keeping_lease(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Have it done aside, the lease kept."""
        self._worker.submit(function, *arguments)
        until_s = self._clock.now_s() + WORKER_TIMEOUT_S
        while not self._worker.is_ready():
            self._board.step()
            if self._clock.now_s() > until_s:
                raise NotReadyError(
                    f"{function.__name__} of {len(self._session.rows)} spots takes {WORKER_TIMEOUT_S:g} s"
                )
        return self._worker.result()

    def _check_unchanged(self) -> None:
        """Measure the first good spot again, and where that is off the second: one alone may be false."""
        spots = self._session.spots
        fit: FieldFit = self._run_keeping_lease(fit_and_warm_up, spots, self._prior)
        places, max_shift_m = self._locator.match_places(spots), RECHECK_SIGMAS * 2.0**0.5 * fit.noise_m
        code_m = 2.0 * self._prior.focal_length_m * self._prior.rad_per_code
        shifts = []
        for index in np.flatnonzero(~fit.outlier & (places >= 0))[:RECHECKS_MAX]:
            previous = self._session.rows[index]
            current = self._locator.measure(int(places[index]), int(previous.x_code), int(previous.y_code))
            if current is None:
                shifts.append("nowhere")
                continue
            x_m = current.x_m - previous.x_m - code_m * (current.x_code - previous.x_code)
            y_m = current.y_m - previous.y_m - code_m * (current.y_code - previous.y_code)
            if np.hypot(x_m, y_m) <= max_shift_m:
                return
            shifts.append(f"{m_to_um(float(np.hypot(x_m, y_m))):.0f} µm off")
        if shifts:
            raise RefusedError(
                f"calibrate: the display or the optics moved since: the spots measured first are now seen "
                f"{' and '.join(shifts)}, expected at most {m_to_um(max_shift_m):.0f} µm; "
                f"delete {self._session.path} to begin anew"
            )

    def _measure_next(self, fit: FieldFit) -> None:
        """Measure one more spot; a place where none is seen is given up for another."""
        misses = 0
        while True:
            codes = np.rint(self._locator.candidate_codes(fit))
            place = self._choose_place(fit, codes)
            row = self._locator.measure(place, int(codes[place, 0]), int(codes[place, 1]))
            if row is not None:
                self._session.rows.append(row)
                self._run_keeping_lease(save_text, self._session.path, self._session.to_json())
                return
            self._unseen_places.add(place)
            misses += 1
            if misses == CONSECUTIVE_MISSES_MAX:
                raise RefusedError(
                    f"calibrate: {CONSECUTIVE_MISSES_MAX} places one after another: {self._locator.not_found_message}"
                )

    def _remaining_initial_places(self) -> list[int]:
        """What is left of the places to begin with."""
        done = {*self._locator.match_places(self._session.spots).tolist(), *self._unseen_places}
        return [place for place in self._locator.initial_places() if place not in done]

    def _choose_place(self, fit: FieldFit, codes: FloatArray) -> int:
        """What to begin with first, then what tells most; never where a good spot is already, or none was seen."""
        initial = self._remaining_initial_places()
        if initial:
            return initial[0]
        done = {*self._locator.match_places(fit.spots)[~fit.outlier].tolist(), *self._unseen_places}
        remaining = [place for place in range(len(codes)) if place not in done]
        if not remaining:
            raise RefusedError(
                f"calibrate: all {len(codes)} places are measured, expected more of them or a lesser goal"
            )
        row: int = self._run_keeping_lease(select_next_spot, fit, codes[remaining])
        return remaining[row]
