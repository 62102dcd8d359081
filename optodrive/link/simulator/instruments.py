"""Simulated instruments: thermal camera, interferometer and load cell, with their noise."""

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, PixelTrace, Run, Signal

INSTRUMENT_SIGMA = {"absorber_temperature_K": 1.0, "displacement_m": 0.25e-6, "force_N": 0.1e-3}
"""Standard deviation of each instrument's noise."""


def measure(
    trace: PixelTrace,
    pulses: FloatArray,
    ambient_k: float,
    bridge_width_m: float,
    noise: float,
    seed: int | np.random.Generator,
    aim_m: FloatArray | None = None,
) -> Measurement:
    """Measure a trace: one run per pixel, named after it. noise: factor on each instrument's noise.

    pulses: [n, 4] as in a recording
    aim_m: [2, pixels of the display] beam aim relative to each pixel's centre, m; None for the centre
    """
    rng = np.random.default_rng(seed)
    runs = []
    for column, pixel in enumerate(trace.pixel.tolist()):
        exact = {
            "absorber_temperature_K": ambient_k + trace.absorber_k[:, column],
            "displacement_m": trace.displacement_m[:, column],
            "force_N": trace.force_n[:, column],
        }
        signals = {
            name: Signal(
                pixel=pixel,
                t_s=trace.t_s,
                value=values + noise * INSTRUMENT_SIGMA[name] * rng.standard_normal(len(values)),
                sigma=noise * INSTRUMENT_SIGMA[name] if noise else None,
            )
            for name, values in exact.items()
        }
        attributes: dict[str, str | float] = {"bridge_width_m": bridge_width_m, "sample": "simulated"}
        if aim_m is not None:
            attributes |= {"aim_x_m": float(aim_m[0, pixel]), "aim_y_m": float(aim_m[1, pixel])}
        runs.append(Run(f"pixel-{pixel}", ambient_k, pulses, signals, attributes))
    return Measurement(tuple(runs))
