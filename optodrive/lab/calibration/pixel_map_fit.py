"""Fit of a display's pixel map to the runs of any number of recordings, with a check of their units."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optodrive.core.document import to_json
from optodrive.core.errors import InputError
from optodrive.core.quantity import m_to_um
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.measurements import Run
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.pixel_map import DEAD, GAIN_MAX, GAIN_MIN, MEASURED, NOT_MEASURED, PixelMap
from optodrive.lab.calibration.pixel_fit import (
    SIGNIFICANCE_SIGMAS,
    Optics,
    PixelResponse,
    PredictHeights,
    ResponseTable,
    compute_response,
    fit_pixel,
    select_centred,
    weighted_mean,
)
from optodrive.lab.calibration.spot_checks import UNIT_FACTORS

RESPONSE_FACTORS = UNIT_FACTORS | {"inches taken for millimetres, or the other way round": 25.4}
"""Errors of units, by the factor on a response."""
UNIT_TOLERANCE = 1.2
"""Largest ratio, either way, of a display's typical gain to a unit's factor."""


def check_responses(where: str, by_pixel: dict[int, list[PixelResponse]], optics: Optics) -> None:
    """Check that a display responds in metres and upwards. Raise InputError with the probable cause."""
    means = []
    for responses in by_pixel.values():
        table = ResponseTable.build(responses)
        is_centred = select_centred(table.aim_m, optics)
        if is_centred.any():
            means.append(weighted_mean(table.ratio[is_centred], table.sigma[is_centred]))
    if not means:
        found = f"heights of {len(by_pixel)} pixels under light aimed at them"
        expected = "at least one run with pulses on the measured pixel and aim_x_m = aim_y_m = 0"
        raise InputError(f"{where}: displacement_m", found, expected)
    mean, sigma = np.array(means).T
    significant = mean[np.abs(mean) > SIGNIFICANCE_SIGMAS * sigma]
    # Dead pixels do not show the unit; the upper half of the responding pixels does.
    size = float(np.median(np.sort(np.abs(significant))[len(significant) // 2 :])) if len(significant) else 0.0
    typical = float(np.median(significant[np.abs(significant) >= 0.5 * size])) if len(significant) else 0.0
    place, unit = f"{where}: displacement_m", _guess_unit(abs(typical))
    hint = f"; these look like {unit}" if unit else ""
    if abs(typical) < GAIN_MIN:
        found = f"at most {size:.2g} of the model's heights at {len(means)} pixels"
        raise InputError(place, found, "a pixel that responds, and heights in metres")
    found = f"{typical:.3g} × the model's heights at {len(means)} pixels"
    if typical < 0.0:
        raise InputError(place, found, f"heights that increase upwards{hint}")
    if typical > GAIN_MAX:
        raise InputError(place, found, f"metres, and the model of this display{hint}")


def _guess_unit(ratio: float) -> str | None:
    near = (
        name for name, factor in RESPONSE_FACTORS.items() if factor / UNIT_TOLERANCE < ratio < factor * UNIT_TOLERANCE
    )
    return next(near, None)


@dataclass
class PixelMapFitter:
    """Collects the responses of runs and fits the pixel map.

    predict: heights by the model of this display
    """

    config: Config
    predict: PredictHeights

    def __post_init__(self) -> None:
        self.by_pixel: dict[int, list[PixelResponse]] = {}
        self.run_count = 0
        self._optics, self._pixel_count = Optics.from_config(self.config), len(build_pixel_layout(self.config.display))

    def add_run(self, where: str, run: Run) -> None:
        """Add a run. Raise InputError for an unknown pixel or an invalid aim."""
        pitch_m = self.config.display.pitch_m
        for signal in run.signals.values():
            if not 0 <= signal.pixel < self._pixel_count:
                expected = f"a pixel of {self.config.name}, 0 to {self._pixel_count - 1}"
                raise InputError(f"{where}: /runs/{run.name}: pixel", signal.pixel, expected)
        response = compute_response(where, run, self.predict, (pitch_m, pitch_m))
        if response is not None:
            self.run_count += 1
            self.by_pixel.setdefault(response.pixel, []).append(response)

    def fit(self, where: str, model: str) -> PixelMap:
        """Return the map. Raise InputError if the heights do not match a display of this model."""
        check_responses(where, self.by_pixel, self._optics)
        estimates = [fit_pixel(self.by_pixel.get(pixel, []), self._optics) for pixel in range(self._pixel_count)]
        states, gains, gain_sigmas, offsets_m, offset_sigmas_m = map(np.array, zip(*estimates, strict=True))
        x_m, y_m, x_sigma_m, y_sigma_m = (each.copy() for each in (*offsets_m.T, *offset_sigmas_m.T))
        return PixelMap(gains, gain_sigmas, x_m, y_m, x_sigma_m, y_sigma_m, states, model)


def compute_stats(pixel_map: PixelMap, runs: int) -> dict[str, Any]:
    """Return counts, extremes and each pixel's values, for --json."""
    measured = np.flatnonzero(pixel_map.state == MEASURED)
    columns: dict[str, FloatArray] = {"gain": pixel_map.gain, "gain_sigma": pixel_map.gain_sigma}
    for name in ("offset_x", "offset_x_sigma", "offset_y", "offset_y_sigma"):
        columns[f"{name}_um"] = m_to_um(getattr(pixel_map, f"{name}_m"))
    return {
        "pixels": len(pixel_map),
        "runs": runs,
        "measured": len(measured),
        "dead": np.flatnonzero(pixel_map.state == DEAD).tolist(),
        "not_measured": np.flatnonzero(pixel_map.state == NOT_MEASURED).tolist(),
        "gain": _compute_gain_stats(pixel_map, measured) if len(measured) else None,
        "offset_um": {axis: _compute_offset_stats(pixel_map, axis) for axis in "xy"},
        "per_pixel": [
            {"pixel": pixel, "state": str(pixel_map.state[pixel])}
            | {name: to_json(float(values[pixel])) for name, values in columns.items()}
            for pixel in range(len(pixel_map))
        ],
    }


def _compute_gain_stats(pixel_map: PixelMap, measured: IntArray) -> dict[str, float]:
    gain = pixel_map.gain[measured]
    ends = (("min", int(gain.argmin())), ("max", int(gain.argmax())))
    stats = {"median": float(np.median(gain))}
    for name, row in ends:
        stats |= {name: float(gain[row]), f"{name}_pixel": int(measured[row])}
    return stats | {"sigma_median": float(np.median(pixel_map.gain_sigma[measured]))}


def _compute_offset_stats(pixel_map: PixelMap, axis: str) -> dict[str, Any] | None:
    sigma_m = getattr(pixel_map, f"offset_{axis}_sigma_m")
    measured = np.flatnonzero(np.isfinite(sigma_m))
    if not len(measured):
        return None
    offset_m = getattr(pixel_map, f"offset_{axis}_m")[measured]
    farthest = int(np.abs(offset_m).argmax())
    return {
        "measured": len(measured),
        "median": m_to_um(float(np.median(offset_m))),
        "farthest": m_to_um(float(offset_m[farthest])),
        "farthest_pixel": int(measured[farthest]),
        "sigma_median": m_to_um(float(np.median(sigma_m[measured]))),
    }
