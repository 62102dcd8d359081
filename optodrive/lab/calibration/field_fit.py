"""Maximum a posteriori fit of a field to spots, with outliers, uncertainty and the most informative next spot.

Every parameter is in units of its prior's sigma: the prior of z is the standard normal distribution.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import log, pi

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, ReadOnlyArrays
from optodrive.device.calibrated_field import TERM_COUNT, CalibratedField, compute_prior_widths, evaluate_terms
from optodrive.device.field_geometry import CENTRE_CODE, FieldGeometry, beam_position_m, compute_parameter_derivatives
from optodrive.lab.calibration.spots import FieldPrior, MeasuredSpots

GEOMETRY_COUNT = len(FieldGeometry._fields)
PARAMETER_COUNT = GEOMETRY_COUNT + 2 * TERM_COUNT
ANNEALING_NOISE_M = (3e-3, 1e-3, 0.3e-3, 0.1e-3, 0.05e-3)
"""Noise scales of the annealing, m: all spots may be outliers at first, few at the end."""
GAUSS_NEWTON_STEPS = 4
"""Gauss-Newton steps per set of weights and scales."""
OUTER_ITERATIONS = 6
"""Largest number of iterations over weights and scales."""
OUTLIER_FRACTION_PRIOR = 0.02
"""Expected fraction of outliers."""
OUTLIER_PRIOR_SPOTS = 10.0
"""Weight of the expected fraction of outliers, in spots."""
SCALE_FACTORS: list[float] = np.geomspace(1.0 / 8.0, 8.0, 13).tolist()
"""Multiples of the expected noise and surface among which the most probable are selected."""
NOISE_LOG_SIGMA, SURFACE_LOG_SIGMA = 0.7, 0.5
"""Prior sigma of the natural logarithms of noise and surface."""
SIGMA_GRID_NODES = 17
"""Nodes per side of the grid on which the field's sigma is stored."""
SAMPLES_PER_SIDE = 9
"""Samples of the display per side at which the variance is evaluated."""


@dataclass(frozen=True, eq=False)
class FieldFit(ReadOnlyArrays):
    """A field fitted to spots, also on the way to the best one.

    terms: [n, t] of the surface at the spots; noise_m, surface_m: of a spot and of the surface, rms per axis;
    z: [u] parameters in units of their sigma; weight: [n] of each spot, 0 to 1; outlier_fraction: expected
    """

    spots: MeasuredSpots
    prior: FieldPrior
    terms: FloatArray
    noise_m: float
    surface_m: float
    z: FloatArray
    weight: FloatArray
    outlier_fraction: float = OUTLIER_FRACTION_PRIOR

    @cached_property
    def parameter_sigma(self) -> FloatArray:
        """Prior sigma of each parameter, [u]."""
        return _compute_parameter_sigma(self.prior, self.surface_m)

    @cached_property
    def geometry(self) -> FieldGeometry:
        """The fitted geometry."""
        return FieldGeometry(*(np.array(self.prior.mean) + self.z[:GEOMETRY_COUNT] * self.prior.sigma).tolist())

    @cached_property
    def coefficients_m(self) -> FloatArray:
        """Coefficients of the surface, [2, terms]."""
        surface = self.z[GEOMETRY_COUNT:] * self.parameter_sigma[GEOMETRY_COUNT:]
        return np.asarray(surface.reshape(2, TERM_COUNT), dtype=np.float64)

    @cached_property
    def residual_m(self) -> FloatArray:
        """Measured less fitted positions, [n, 2]."""
        angles_rad = (np.stack([self.spots.x_code, self.spots.y_code]) - CENTRE_CODE) * self.prior.rad_per_code
        fitted_m = np.stack(beam_position_m(self.geometry, *angles_rad))
        residual_m = np.stack([self.spots.x_m, self.spots.y_m]) - fitted_m - self.coefficients_m @ self.terms.T
        return np.asarray(residual_m.T, dtype=np.float64)

    @property
    def outlier(self) -> BoolArray:
        """Rejected spots, [n]."""
        return np.asarray(self.weight < 0.5)

    @property
    def rms_m(self) -> float:
        """Root mean square length of the inliers' residuals, m. It is NaN without spots."""
        inlier_m = self.residual_m[~self.outlier]
        return float(np.sqrt((inlier_m**2).sum(axis=1).mean())) if len(inlier_m) else float("nan")

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of all parameters in units of their sigma, [u, u]."""
        matrix, _ = self._linearise(self.noise_m)
        return np.asarray(np.linalg.inv(matrix + np.eye(PARAMETER_COUNT)), dtype=np.float64)

    @cached_property
    def field(self) -> CalibratedField:
        """The field, with its uncertainty."""
        grid_sigma_m = self.sigma_m(*self.prior.extent.build_grid(SIGMA_GRID_NODES))
        return CalibratedField(
            geometry=self.geometry,
            surface_m=self.coefficients_m,
            extent=self.prior.extent,
            rad_per_code=self.prior.rad_per_code,
            focal_length_m=self.prior.focal_length_m,
            sigma_grid_m=grid_sigma_m.reshape(SIGMA_GRID_NODES, SIGMA_GRID_NODES),
            display=self.prior.display,
            wiring=self.prior.wiring,
        )

    def jacobian_m(self, x_code: FloatArray, y_code: FloatArray) -> FloatArray:
        """Return the derivatives of positions at codes [n] by each parameter, m, [2, n, u]."""
        jacobian = np.zeros((2, len(x_code), PARAMETER_COUNT))
        x_rad, y_rad = ((code - CENTRE_CODE) * self.prior.rad_per_code for code in (x_code, y_code))
        derivatives = compute_parameter_derivatives(self.geometry, self.prior.sigma, x_rad, y_rad)
        jacobian[:, :, :GEOMETRY_COUNT] = derivatives
        surface = evaluate_terms(self.prior.extent, x_code, y_code)
        for axis in range(2):
            begin = GEOMETRY_COUNT + axis * TERM_COUNT
            part = slice(begin, begin + TERM_COUNT)
            jacobian[axis, :, part] = surface * self.parameter_sigma[part]
        return jacobian

    def sigma_m(self, x_code: FloatArray, y_code: FloatArray) -> FloatArray:
        """Return one sigma at codes [n] per axis, averaged over both axes, m, [n]."""
        jacobian = self.jacobian_m(x_code, y_code)
        variance = np.einsum("anu,uv,anv->n", jacobian, self.covariance, jacobian, optimize=True) / 2.0
        return np.asarray(np.sqrt(variance))

    def _linearise(self, noise_m: float) -> tuple[FloatArray, FloatArray]:
        """Return matrix [u, u] and vector [u] of the linearised problem without its prior."""
        jacobian = self.jacobian_m(self.spots.x_code, self.spots.y_code)
        weighted = jacobian * (self.weight / noise_m**2)[None, :, None]
        matrix = np.tensordot(weighted, jacobian, ([0, 1], [0, 1]))
        return matrix, np.tensordot(weighted, self.residual_m.T, ([0, 1], [0, 1]))

    def converge(self, noise_m: float, count: int = GAUSS_NEWTON_STEPS) -> "FieldFit":
        """Take full Gauss-Newton steps. The problem is nearly linear, so that no step overshoots."""
        fit = self
        for _ in range(count):
            matrix, vector = fit._linearise(noise_m)
            step = np.linalg.solve(matrix + np.eye(PARAMETER_COUNT), vector - fit.z)
            fit = replace(fit, z=np.asarray(fit.z + step, dtype=np.float64))
        return fit

    def anneal(self) -> "FieldFit":
        """Fit from the nominal geometry at decreasing noise scales, weighting each spot by its inlier probability."""
        fit = self
        for scale_m in ANNEALING_NOISE_M:
            for _ in range(GAUSS_NEWTON_STEPS):
                fit = replace(fit, weight=fit._compute_inlier_probability(scale_m)).converge(scale_m, 1)
        return fit.classify_outliers()

    def _compute_inlier_probability(self, scale_m: float | FloatArray) -> FloatArray:
        """Return each spot's probability of being an inlier at a noise scale, [n]."""
        distance2 = (self.residual_m**2).sum(axis=1)
        inlier_density = (1.0 - self.outlier_fraction) * np.exp(-0.5 * distance2 / scale_m**2) / (2.0 * pi * scale_m**2)
        return np.asarray(inlier_density / (inlier_density + self.outlier_fraction / self.prior.field_area_m2))

    def classify_outliers(self) -> "FieldFit":
        """Classify each spot as inlier or outlier from its residual and the field's uncertainty there."""
        scale_m = np.hypot(self.noise_m, self.sigma_m(self.spots.x_code, self.spots.y_code))
        weight = (self._compute_inlier_probability(scale_m) > 0.5).astype(np.float64)
        outliers = len(weight) - weight.sum() + OUTLIER_PRIOR_SPOTS * OUTLIER_FRACTION_PRIOR
        return replace(self, weight=weight, outlier_fraction=float(outliers / (len(weight) + OUTLIER_PRIOR_SPOTS)))

    def estimate_scales(self, known_noise_m: float | None) -> "FieldFit":
        """Select the jointly most probable noise and surface, marginalised over the parameters."""
        matrix, vector = self._linearise(1.0)
        square, count = float((self.weight * self.residual_m.T**2).sum()), 2.0 * float(self.weight.sum())
        best, chosen = -np.inf, self
        for noise in SCALE_FACTORS if known_noise_m is None else [known_noise_m / self.prior.noise_m]:
            for surface in SCALE_FACTORS:
                noise_m, surface_m = noise * self.prior.noise_m, surface * self.prior.surface_m
                # The Jacobian of a parameter scales with its prior sigma.
                scale_ratio = _compute_parameter_sigma(self.prior, surface_m) / self.parameter_sigma
                precision = matrix * np.outer(scale_ratio, scale_ratio) / noise_m**2 + np.eye(PARAMETER_COUNT)
                z = self.z / scale_ratio
                gradient = vector * scale_ratio / noise_m**2 - z
                root = np.linalg.cholesky(precision)
                gain = np.linalg.solve(root, gradient)
                log_probability = -0.5 * (square / noise_m**2 + z @ z - gain @ gain)
                log_probability -= count * log(noise_m) + float(np.log(np.diag(root)).sum())
                log_probability -= 0.5 * (log(surface) / SURFACE_LOG_SIGMA) ** 2
                log_probability -= 0.5 * (log(noise) / NOISE_LOG_SIGMA) ** 2
                if log_probability > best:
                    best, chosen = log_probability, replace(self, noise_m=noise_m, surface_m=surface_m)
        return replace(chosen, z=self.z * self.parameter_sigma / chosen.parameter_sigma)


def _compute_parameter_sigma(prior: FieldPrior, surface_m: float) -> FloatArray:
    return np.concatenate([prior.sigma, np.tile(surface_m * compute_prior_widths(), 2)])


def fit_field(spots: MeasuredSpots, prior: FieldPrior, noise_m: float | None = None) -> FieldFit:
    """Fit the most probable field to any number of spots, also none.

    noise_m: noise of a spot per axis, m; fitted if None.
    """
    terms = evaluate_terms(prior.extent, spots.x_code, spots.y_code)
    scales = noise_m or prior.noise_m, prior.surface_m
    fit = FieldFit(spots, prior, terms, *scales, np.zeros(PARAMETER_COUNT), np.ones(len(spots))).anneal()
    for _ in range(OUTER_ITERATIONS):
        previous_weight = fit.weight
        fit = fit.converge(fit.noise_m).estimate_scales(noise_m).classify_outliers()
        if np.array_equal(previous_weight, fit.weight):
            break
    return fit.converge(fit.noise_m)


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
    reduction = np.linalg.solve(measurement_covariance, cross_covariance @ cross_covariance.transpose(0, 2, 1))
    return int(np.argmax(np.trace(reduction, axis1=1, axis2=2)))
