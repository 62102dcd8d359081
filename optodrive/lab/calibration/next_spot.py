"""Optimal design of the next spot to measure."""

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.calibration.field_fit import FieldFit

SAMPLES_PER_SIDE = 9
"""Samples of the display per side at which the variance is evaluated."""


def select_next_spot(fit: FieldFit, candidates: FloatArray) -> int:
    """Return the row of candidates [k, 2], x_code and y_code, that most reduces the mean variance over the display."""
    display_jacobian = fit.jacobian_m(*fit.prior.display_extent.build_grid(SAMPLES_PER_SIDE))
    parameter_count = display_jacobian.shape[-1]
    display_jacobian = display_jacobian.reshape(-1, parameter_count)
    candidate_jacobian = fit.jacobian_m(candidates[:, 0], candidates[:, 1]).transpose(1, 0, 2)
    # One more spot with Jacobian A reduces the covariance C by C Aᵀ (A C Aᵀ + σ²)⁻¹ A C.
    candidate_covariance = candidate_jacobian @ fit.covariance
    cross_covariance = candidate_covariance @ display_jacobian.T
    measurement_covariance = candidate_covariance @ candidate_jacobian.transpose(0, 2, 1) + fit.noise_m**2 * np.eye(2)
    variance_reduction = np.trace(
        np.linalg.solve(measurement_covariance, cross_covariance @ cross_covariance.transpose(0, 2, 1)),
        axis1=1,
        axis2=2,
    )
    return int(np.argmax(variance_reduction))
