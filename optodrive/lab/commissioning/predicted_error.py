"""Predicted error of a fitted field over the display."""

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config, build_pixel_layout
from optodrive.lab.calibration.field_fit import FieldFit
from optodrive.link.protocol.quantisation import CENTRE_CODE

GRID_SIDE = 15
"""Grid points per side at which the uncertainty is averaged."""


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
