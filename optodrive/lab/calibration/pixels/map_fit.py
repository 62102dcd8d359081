"""Runs of any number of recordings to a map of the display's pixels, and what is to be said of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Run
from optodrive.core.units import m_to_um
from optodrive.device.config import Config, pixel_layout
from optodrive.device.pixel_map import DEAD, MEASURED, NOT_MEASURED, PixelMap
from optodrive.lab.calibration.pixels.checks import check_responses
from optodrive.lab.calibration.pixels.fit import Optics, fit_pixel
from optodrive.lab.calibration.pixels.response import Predict, Response, response_of


@dataclass
class Responses:
    """What runs show, gathered run by run. predict: as the model of this display has it."""

    config: Config
    predict: Predict

    def __post_init__(self) -> None:
        self.by_pixel: dict[int, list[Response]] = {}
        self.runs = 0
        self._optics, self._count = Optics.of(self.config), len(pixel_layout(self.config.display))

    def add(self, where: str, run: Run) -> None:
        """Take a run in; InputError for a pixel that the display does not have, or an aim that is none."""
        pitch_m = self.config.display.pitch_m
        for signal in run.signals.values():
            if not 0 <= signal.pixel < self._count:
                expected = f"a pixel of {self.config.name}, 0 to {self._count - 1}"
                raise InputError(f"{where}: /runs/{run.name}: pixel", signal.pixel, expected)
        found = response_of(where, run, self.predict, (pitch_m, pitch_m))
        if found is not None:
            self.runs += 1
            self.by_pixel.setdefault(found.pixel, []).append(found)

    def fitted(self, where: str, model: str) -> PixelMap:
        """The map; InputError where the heights are those of no display of this model."""
        check_responses(where, self.by_pixel, self._optics)
        each = [fit_pixel(self.by_pixel.get(pixel, []), self._optics) for pixel in range(self._count)]
        offset_m = np.array([found.offset_m for found in each]).T.copy()
        sigma_m = np.array([found.offset_sigma_m for found in each]).T.copy()
        return PixelMap(
            gain=np.array([found.gain for found in each]),
            gain_sigma=np.array([found.gain_sigma for found in each]),
            offset_x_m=offset_m[0].copy(),
            offset_y_m=offset_m[1].copy(),
            offset_x_sigma_m=sigma_m[0].copy(),
            offset_y_sigma_m=sigma_m[1].copy(),
            state=np.array([found.state for found in each]),
            model=model,
        )


def figures(known: PixelMap, runs: int) -> dict[str, Any]:
    """Counts, extremes and each pixel, for --json."""
    measured = np.flatnonzero(known.state == MEASURED)
    gain = known.gain[measured]
    return {
        "pixels": len(known),
        "runs": runs,
        "measured": len(measured),
        "dead": np.flatnonzero(known.state == DEAD).tolist(),
        "not_measured": np.flatnonzero(known.state == NOT_MEASURED).tolist(),
        "gain": None
        if not len(measured)
        else {
            "median": float(np.median(gain)),
            "least": float(gain.min()),
            "least_pixel": int(measured[gain.argmin()]),
            "most": float(gain.max()),
            "most_pixel": int(measured[gain.argmax()]),
            "sigma_median": float(np.median(known.gain_sigma[measured])),
        },
        "offset_um": {axis: _offset(known, axis) for axis in "xy"},
        "each": [
            {
                "pixel": pixel,
                "state": str(known.state[pixel]),
                "gain": float(known.gain[pixel]),
                "gain_sigma": _finite(known.gain_sigma[pixel]),
                "offset_x_um": m_to_um(float(known.offset_x_m[pixel])),
                "offset_x_sigma_um": _finite(m_to_um(known.offset_x_sigma_m[pixel])),
                "offset_y_um": m_to_um(float(known.offset_y_m[pixel])),
                "offset_y_sigma_um": _finite(m_to_um(known.offset_y_sigma_m[pixel])),
            }
            for pixel in range(len(known))
        ],
    }


def _offset(known: PixelMap, axis: str) -> dict[str, Any] | None:
    sigma_m = getattr(known, f"offset_{axis}_sigma_m")
    there = np.flatnonzero(np.isfinite(sigma_m))
    if not len(there):
        return None
    offset_m = getattr(known, f"offset_{axis}_m")[there]
    farthest = int(np.abs(offset_m).argmax())
    return {
        "measured": len(there),
        "median": m_to_um(float(np.median(offset_m))),
        "farthest": m_to_um(float(offset_m[farthest])),
        "farthest_pixel": int(there[farthest]),
        "sigma_median": m_to_um(float(np.median(sigma_m[there]))),
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
