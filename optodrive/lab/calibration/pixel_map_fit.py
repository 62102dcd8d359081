"""Fit of a display's pixel map to the runs of any number of recordings, with a check of their units."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optodrive.core.document import to_json
from optodrive.core.errors import InputError
from optodrive.core.quantity import m_to_um
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Run
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.pixel_map import DEAD, GAIN_MAX, GAIN_MIN, MEASURED, NOT_MEASURED, PixelMap
from optodrive.lab.calibration.pixel_fit import (
    SIGNIFICANCE_SIGMAS,
    Optics,
    PixelResponse,
    PredictHeights,
    compute_response,
    fit_pixel,
    select_centred,
    weighted_mean,
)

UNIT_FACTORS = {
    "millimetres": 1e3,
    "micrometres": 1e6,
    "centimetres": 1e2,
    "inches": 1.0 / 0.0254,
    "inches taken for millimetres, or the other way round": 25.4,
}
"""Units that are mistaken for metres, per metre."""
UNIT_TOLERANCE = 1.2
"""Largest ratio, either way, of a display's typical gain to a unit's factor."""


def check_responses(where: str, by_pixel: dict[int, list[PixelResponse]], optics: Optics) -> None:
    """Check that a display responds in metres and upwards. Raise InputError with the probable cause."""
    means = []
    for responses in by_pixel.values():
        aim_m = np.array([[item.aim_x_m for item in responses], [item.aim_y_m for item in responses]])
        is_centred = select_centred(aim_m, optics)
        if is_centred.any():
            value = np.array([item.ratio for item in responses])[is_centred]
            sigma = np.array([item.sigma for item in responses])[is_centred]
            means.append(weighted_mean(value, sigma))
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
    for name, factor in UNIT_FACTORS.items():
        if factor / UNIT_TOLERANCE < ratio < factor * UNIT_TOLERANCE:
            return name
    return None


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
        offset_m = np.array([found.offset_m for found in estimates]).T.copy()
        sigma_m = np.array([found.offset_sigma_m for found in estimates]).T.copy()
        return PixelMap(
            gain=np.array([found.gain for found in estimates]),
            gain_sigma=np.array([found.gain_sigma for found in estimates]),
            offset_x_m=offset_m[0].copy(),
            offset_y_m=offset_m[1].copy(),
            offset_x_sigma_m=sigma_m[0].copy(),
            offset_y_sigma_m=sigma_m[1].copy(),
            state=np.array([found.state for found in estimates]),
            model=model,
        )


def compute_stats(pixel_map: PixelMap, runs: int) -> dict[str, Any]:
    """Return counts, extremes and each pixel's values, for --json."""
    measured = np.flatnonzero(pixel_map.state == MEASURED)
    gain = pixel_map.gain[measured]
    columns: dict[str, FloatArray] = {"gain": pixel_map.gain, "gain_sigma": pixel_map.gain_sigma}
    for name in ("offset_x", "offset_x_sigma", "offset_y", "offset_y_sigma"):
        columns[f"{name}_um"] = m_to_um(getattr(pixel_map, f"{name}_m"))
    return {
        "pixels": len(pixel_map),
        "runs": runs,
        "measured": len(measured),
        "dead": np.flatnonzero(pixel_map.state == DEAD).tolist(),
        "not_measured": np.flatnonzero(pixel_map.state == NOT_MEASURED).tolist(),
        "gain": None
        if not len(measured)
        else {
            "median": float(np.median(gain)),
            "min": float(gain.min()),
            "min_pixel": int(measured[gain.argmin()]),
            "max": float(gain.max()),
            "max_pixel": int(measured[gain.argmax()]),
            "sigma_median": float(np.median(pixel_map.gain_sigma[measured])),
        },
        "offset_um": {axis: _compute_offset_stats(pixel_map, axis) for axis in "xy"},
        "per_pixel": [
            {"pixel": pixel, "state": str(pixel_map.state[pixel])}
            | {name: to_json(float(values[pixel])) for name, values in columns.items()}
            for pixel in range(len(pixel_map))
        ],
    }


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
