"""Where to measure next: where it makes the whole field surest."""

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.calibration.field_fit import FieldFit

PLACES = 9
"""The display is looked at in so many places a side."""


def next_spot(fit: FieldFit, candidates: FloatArray) -> int:
    """The row of candidates [k, 2], x_code and y_code, that most lowers the mean variance over the display."""
    looked_at = fit.derivatives_m(*fit.prior.pixels.grid(PLACES))
    width = looked_at.shape[-1]
    looked_at = looked_at.reshape(-1, width)
    asked = fit.derivatives_m(candidates[:, 0], candidates[:, 1]).transpose(1, 0, 2)
    # One more spot takes C Aᵀ (A C Aᵀ + σ²)⁻¹ A C from the covariance C.
    reached = asked @ fit.covariance
    seen = reached @ looked_at.T
    own = reached @ asked.transpose(0, 2, 1) + fit.noise_m**2 * np.eye(2)
    gained = np.trace(np.linalg.solve(own, seen @ seen.transpose(0, 2, 1)), axis1=1, axis2=2)
    return int(np.argmax(gained))
