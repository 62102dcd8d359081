"""Closed-loop calibration: measure the most informative spot, fit, and repeat until the field is accurate enough.

A `SpotLocator`, a sensor or a person, offers candidate positions and measures the spot at the chosen one. The spots are
saved after each one so that an interrupted calibration can be resumed.
"""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, NotReadyError, RefusedError
from optodrive.core.files import atomic_write
from optodrive.core.quantity import m_to_um
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.worker_process import WorkerProcess
from optodrive.device.config import Config, build_pixel_layout
from optodrive.lab.calibration.field_fit import FieldFit, fit_field, select_next_spot
from optodrive.lab.calibration.spot_checks import check_fit, check_spots
from optodrive.lab.calibration.spots import FieldPrior, MeasuredSpots
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.link.protocol.quantisation import CENTRE_CODE

GRID_SIDE = 15
"""Grid points per side at which the uncertainty is averaged."""
FORMAT = "optodrive-calibration-session"
VERSION = 1
WORKER_TIMEOUT_S = 30.0
"""Time limit of a computation, during which the board stays armed."""
CONSECUTIVE_MISSES_MAX = 3
"""Consecutive positions without a spot that end the calibration."""
SPOTS_MIN = 20
"""Minimum number of spots for a credible error estimate."""
CONFIDENCE_FACTOR = 1.3
"""Ratio of the 90 % bound of the actual error to its prediction."""


RECHECKS_MAX = 2
"""Maximum number of spots that a resumed calibration measures again."""
RECHECK_SIGMAS = 5.0
"""Two measurements of a spot differ if they are more sigmas apart than this."""


def build_code_grid(config: Config, margin_m: float, side: int) -> FloatArray:
    """Build a grid of nominal codes over the display and a margin, [side², 2], by rows from the bottom."""
    layout = build_pixel_layout(config.display)
    code_m = 2.0 * config.scanner.focal_length_m * config.scanner.rad_per_code
    x, y = (
        CENTRE_CODE + np.linspace(-1.0, 1.0, side) * (float(np.abs(axis).max()) + margin_m) / code_m
        for axis in (layout.x_m, layout.y_m)
    )
    return np.column_stack([np.tile(x, side), np.repeat(y, side)])


def predicted_rms_m(fit: FieldFit, config: Config) -> float:
    """Return the predicted rms length of the field's error over the display, m."""
    sigma_m = fit.field.sigma_m(*build_code_grid(config, 0.0, GRID_SIDE).T)
    return float(np.sqrt(2.0 * np.mean(sigma_m**2)))


class SpotRow(NamedTuple):
    """One spot: commanded codes and measured position, m."""

    x_code: float
    y_code: float
    x_m: float
    y_m: float


class CalibrationSession:
    """The spots of one calibration and their file beside the output file."""

    def __init__(self, path: Path, header: dict[str, Any], rows: list[SpotRow]) -> None:
        self.path, self.rows = path, rows
        self._header = header

    @classmethod
    def load_or_create(cls, out: Path, config: Config) -> Self:
        """Load the session of an output file, or create one. Raise InputError for a session of another display."""
        path = session_path_for(out)
        header = {
            "format": FORMAT,
            "version": VERSION,
            "display": config.name,
            "focal_length_m": config.scanner.focal_length_m,
            "rad_per_code": config.scanner.rad_per_code,
        }
        return cls(path, header, _read_rows(path, header) if path.exists() else [])

    @property
    def spots(self) -> MeasuredSpots:
        """All spots, in order of measurement."""
        return MeasuredSpots.from_table(np.array(self.rows, dtype=np.float64))

    def to_json(self) -> str:
        """Return the content of the file."""
        return json.dumps({**self._header, "spots": self.rows}) + "\n"


def session_path_for(out: Path) -> Path:
    """Return the path of an output file's session."""
    return out.with_name(out.name + ".session.json")


def save_text(path: Path, text: str) -> None:
    """Replace the file and flush it to disk."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _read_rows(path: Path, header: dict[str, Any]) -> list[SpotRow]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    except (ValueError, RecursionError):
        raise InputError(str(path), "not JSON", "a calibration's session; delete it to start again") from None
    for key, value in header.items():
        stored = document.get(key) if isinstance(document, dict) else None
        if stored != value:
            raise InputError(f"{path}: {key}", stored, f"{value!r}; delete the file to start again")
    try:
        rows = [SpotRow(*(float(number) for number in row)) for row in document["spots"]]
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: spots", "something else", "rows of x_code, y_code, x_m, y_m") from None
    if not np.all(np.isfinite(np.array(rows, dtype=np.float64))):
        raise InputError(f"{path}: spots", "a number that is not finite", "finite numbers")
    return rows


class SpotLocator(Protocol):
    """Source of candidate positions and of spot measurements."""

    @property
    def name(self) -> str:
        """Name of the sensor or method."""

    @property
    def not_found_message(self) -> str:
        """Message if no spot is found: value and expectation."""

    def candidate_codes(self, fit: FieldFit) -> FloatArray:
        """Return candidate codes, [k, 2], in the same number and order for each fit."""

    def initial_places(self) -> list[int]:
        """Return the first candidates to measure: corners, edges and centre."""

    def match_places(self, spots: MeasuredSpots) -> IntArray:
        """Return the candidate of each spot, -1 for none, [n]."""

    def measure(self, place: int, x_code: int, y_code: int) -> SpotRow | None:
        """Measure the spot of a candidate. Return None if no spot is found."""


@dataclass(frozen=True)
class MeasurementProgress:
    """Progress after a spot: number of spots, and the predicted rms error of the field over the display, m.

    error_bound_m: 90 % bound of that error
    """

    spots: int
    predicted_error_m: float
    error_bound_m: float
    outliers: int


@dataclass(frozen=True)
class MeasurementResult:
    """Result: the fit, its predicted error with its 90 % bound, m, and whether the bound meets the target."""

    fit: FieldFit
    predicted_error_m: float
    error_bound_m: float
    target_reached: bool


def fit_and_warm_up(spots: MeasuredSpots, prior: FieldPrior) -> FieldFit:
    """Fit the field and build its inverse now, which would later delay the lease."""
    fit = fit_field(spots, prior)
    # Its result is kept in the field and not needed here.
    fit.field.codes(np.zeros(1), np.zeros(1))
    return fit


class MeasurementLoop:
    """One calibration on an armed board. Each measured spot is saved in the session before an error is raised."""

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
        """Measure until the error bound meets the target or spots_max is reached. Report progress after each spot.

        Continue an interrupted session only if its first spot is still at the same position, else raise RefusedError.
        """
        # Before anything new is measured: spots of two positions of the display would fit one wrong field.
        if self._session.rows:
            self._check_unchanged()
        while True:
            fit: FieldFit = self._run_keeping_lease(fit_and_warm_up, self._session.spots, self._prior)
            predicted_error_m: float = self._run_keeping_lease(predicted_rms_m, fit, self._board.config)
            count, error_bound_m = len(self._session.rows), CONFIDENCE_FACTOR * predicted_error_m
            on_progress(MeasurementProgress(count, predicted_error_m, error_bound_m, int(fit.outlier.sum())))
            # Corners, edges and centre first: the error bound of a fit that lacks one of them means nothing there.
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
        """Run a function in the worker process and keep the lease. Raise NotReadyError on timeout."""
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
        """Measure the first valid spot again, and the second if the first one has moved: it may be an outlier."""
        spots = self._session.spots
        fit: FieldFit = self._run_keeping_lease(fit_and_warm_up, spots, self._prior)
        # √2: the difference of two measurements has the noise of both.
        places, max_shift_m = self._locator.match_places(spots), RECHECK_SIGMAS * 2.0**0.5 * fit.noise_m
        code_m = 2.0 * self._prior.focal_length_m * self._prior.rad_per_code
        shifts = []
        for index in np.flatnonzero(~fit.outlier & (places >= 0))[:RECHECKS_MAX]:
            previous = self._session.rows[index]
            current = self._locator.measure(int(places[index]), int(previous.x_code), int(previous.y_code))
            if current is None:
                shifts.append("nowhere")
                continue
            # A person may move the spot to other codes than before; only what these do not explain is a shift.
            x_m = current.x_m - previous.x_m - code_m * (current.x_code - previous.x_code)
            y_m = current.y_m - previous.y_m - code_m * (current.y_code - previous.y_code)
            if np.hypot(x_m, y_m) <= max_shift_m:
                return
            shifts.append(f"{m_to_um(float(np.hypot(x_m, y_m))):.0f} µm off")
        if shifts:
            raise RefusedError(
                f"calibrate: the display or the optics moved since: the spots measured first are now "
                f"{' and '.join(shifts)}, expected at most {m_to_um(max_shift_m):.0f} µm; "
                f"delete {self._session.path} to start again"
            )

    def _measure_next(self, fit: FieldFit) -> None:
        """Measure one more spot. Exclude positions where no spot is found."""
        misses = 0
        while True:
            codes = np.rint(self._locator.candidate_codes(fit))
            place = self._choose_place(fit, codes)
            row = self._locator.measure(place, int(codes[place, 0]), int(codes[place, 1]))
            if row is not None:
                self._session.rows.append(row)
                # After each spot and flushed: each costs light and a person's time. In the worker, because a flush may
                # take longer than the lease.
                self._run_keeping_lease(save_text, self._session.path, self._session.to_json())
                return
            # Of this run alone: a cover may be gone at the next one.
            self._unseen_places.add(place)
            misses += 1
            if misses == CONSECUTIVE_MISSES_MAX:
                raise RefusedError(
                    f"calibrate: {CONSECUTIVE_MISSES_MAX} consecutive positions without a spot: "
                    f"{self._locator.not_found_message}"
                )

    def _remaining_initial_places(self) -> list[int]:
        """Return the initial positions not yet measured."""
        done = {*self._locator.match_places(self._session.spots).tolist(), *self._unseen_places}
        return [place for place in self._locator.initial_places() if place not in done]

    def _choose_place(self, fit: FieldFit, codes: FloatArray) -> int:
        """Choose the next position: the initial ones first, then the most informative one not yet measured."""
        initial = self._remaining_initial_places()
        if initial:
            return initial[0]
        # An outlier, as by a reflection, may be measured again.
        done = {*self._locator.match_places(fit.spots)[~fit.outlier].tolist(), *self._unseen_places}
        remaining = [place for place in range(len(codes)) if place not in done]
        if not remaining:
            raise RefusedError(
                f"calibrate: all {len(codes)} positions are measured, expected more of them or a larger target"
            )
        row: int = self._run_keeping_lease(select_next_spot, fit, codes[remaining])
        return remaining[row]
