"""Maximum a posteriori fit of a field to spots, with outliers, uncertainty and the most informative next spot.

Every parameter is in units of its prior's sigma: the prior of z is the standard normal distribution.
"""

from dataclasses import dataclass
from math import log, pi

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, freeze_arrays
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
class FieldFit:
    """A fitted field with its data and its uncertainty.

    outlier: [n] rejected spots; residual_m: [n, 2] measured less fitted; noise_m, surface_m: rms per axis, fitted
    covariance: [u, u] of all parameters in units of parameter_sigma [u]
    """

    field: CalibratedField
    spots: MeasuredSpots
    prior: FieldPrior
    outlier: BoolArray
    residual_m: FloatArray
    noise_m: float
    surface_m: float
    parameter_sigma: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def rms_m(self) -> float:
        """Root mean square length of the inliers' residuals, m. It is NaN without spots."""
        inlier_m = self.residual_m[~self.outlier]
        return float(np.sqrt((inlier_m**2).sum(axis=1).mean())) if len(inlier_m) else float("nan")

    def jacobian_m(self, x_code: FloatArray, y_code: FloatArray) -> FloatArray:
        """Return the derivatives of positions at codes [n] by each parameter, m, [2, n, u]."""
        return _jacobian(self.field.geometry, self.prior, self.parameter_sigma, x_code, y_code)


@dataclass(frozen=True)
class _Scales:
    """Noise of a spot and rms of the surface, both per axis, m."""

    noise_m: float
    surface_m: float

    def parameter_sigma(self, prior: FieldPrior) -> FloatArray:
        return np.concatenate([prior.sigma, np.tile(self.surface_m * compute_prior_widths(), 2)])


def fit_field(spots: MeasuredSpots, prior: FieldPrior, noise_m: float | None = None) -> FieldFit:
    """Fit the most probable field to any number of spots, also none.

    noise_m: noise of a spot per axis, m; fitted if None.
    """
    fitter = _FieldFitter(spots, prior, noise_m)
    fitter.anneal()
    for _ in range(OUTER_ITERATIONS):
        previous_weight = fitter.weight.copy()
        fitter.converge()
        fitter.estimate_scales()
        fitter.classify_outliers()
        if np.array_equal(previous_weight, fitter.weight):
            break
    fitter.converge()
    return fitter.build_result()


class _FieldFitter:
    """State of a fit.

    z: [u] parameters in units of their sigma
    weight: [n] of each spot, 0 to 1
    """

    def __init__(self, spots: MeasuredSpots, prior: FieldPrior, noise_m: float | None) -> None:
        self.spots, self.prior, self.known_noise_m = spots, prior, noise_m
        self.scales = _Scales(noise_m or prior.noise_m, prior.surface_m)
        self.z = np.zeros(PARAMETER_COUNT)
        self.weight = np.ones(len(spots))
        self.outlier_fraction = OUTLIER_FRACTION_PRIOR
        self.surface_terms = evaluate_terms(prior.extent, spots.x_code, spots.y_code)
        self.measured_m = np.stack([spots.x_m, spots.y_m])

    @property
    def parameter_sigma(self) -> FloatArray:
        return self.scales.parameter_sigma(self.prior)

    @property
    def geometry(self) -> FieldGeometry:
        return FieldGeometry(*(np.array(self.prior.mean) + self.z[:GEOMETRY_COUNT] * self.prior.sigma).tolist())

    def surface_coefficients_m(self) -> FloatArray:
        coefficients: FloatArray = (self.z[GEOMETRY_COUNT:] * self.parameter_sigma[GEOMETRY_COUNT:]).reshape(
            2, TERM_COUNT
        )
        return coefficients

    def angles_rad(self) -> FloatArray:
        codes = np.stack([self.spots.x_code, self.spots.y_code])
        return (codes - CENTRE_CODE) * self.prior.rad_per_code

    def residual_m(self) -> FloatArray:
        """Return measured less fitted positions, m, [2, n]."""
        residual: FloatArray = (
            self.measured_m
            - np.stack(beam_position_m(self.geometry, *self.angles_rad()))
            - self.surface_coefficients_m() @ self.surface_terms.T
        )
        return residual

    def _normal_equations(self, noise_m: float) -> tuple[FloatArray, FloatArray]:
        """Return matrix [u, u] and vector [u] of the linearised problem without its prior."""
        jacobian = _jacobian(self.geometry, self.prior, self.parameter_sigma, self.spots.x_code, self.spots.y_code)
        weighted = jacobian * (self.weight / noise_m**2)[None, :, None]
        return np.tensordot(weighted, jacobian, ([0, 1], [0, 1])), np.tensordot(
            weighted, self.residual_m(), ([0, 1], [0, 1])
        )

    def gauss_newton_step(self, noise_m: float) -> None:
        """Take one full Gauss-Newton step. The problem is nearly linear, so that no step overshoots."""
        matrix, vector = self._normal_equations(noise_m)
        step = np.linalg.solve(matrix + np.eye(PARAMETER_COUNT), vector - self.z)
        self.z = np.asarray(self.z + step, dtype=np.float64)

    def anneal(self) -> None:
        """Fit from the nominal geometry at decreasing noise scales, weighting each spot by its inlier probability."""
        for scale_m in ANNEALING_NOISE_M:
            for _ in range(GAUSS_NEWTON_STEPS):
                self.weight = self._inlier_probability(scale_m)
                self.gauss_newton_step(scale_m)
        self.classify_outliers()

    def converge(self) -> None:
        """Iterate to the most probable parameters at the current weights and scales."""
        for _ in range(GAUSS_NEWTON_STEPS):
            self.gauss_newton_step(self.scales.noise_m)

    def _inlier_probability(self, scale_m: float | FloatArray) -> FloatArray:
        """Return each spot's probability of being an inlier at a noise scale, [n]."""
        distance2 = (self.residual_m() ** 2).sum(axis=0)
        inlier_density = (1.0 - self.outlier_fraction) * np.exp(-0.5 * distance2 / scale_m**2) / (2.0 * pi * scale_m**2)
        probability: FloatArray = inlier_density / (inlier_density + self.outlier_fraction / self.prior.field_area_m2)
        return probability

    def classify_outliers(self) -> None:
        """Classify each spot as inlier or outlier from its residual and the field's uncertainty there."""
        scale_m = np.hypot(self.scales.noise_m, self._sigma_m())
        self.weight = (self._inlier_probability(scale_m) > 0.5).astype(np.float64)
        outlier_count = len(self.weight) - self.weight.sum()
        self.outlier_fraction = float(
            (outlier_count + OUTLIER_PRIOR_SPOTS * OUTLIER_FRACTION_PRIOR) / (len(self.weight) + OUTLIER_PRIOR_SPOTS)
        )

    def _covariance(self) -> FloatArray:
        matrix, _ = self._normal_equations(self.scales.noise_m)
        return np.asarray(np.linalg.inv(matrix + np.eye(PARAMETER_COUNT)), dtype=np.float64)

    def _sigma_m(self) -> FloatArray:
        jacobian = _jacobian(self.geometry, self.prior, self.parameter_sigma, self.spots.x_code, self.spots.y_code)
        return _sigma_m(jacobian, self._covariance())

    def estimate_scales(self) -> None:
        """Select the jointly most probable noise and surface, marginalised over the parameters."""
        matrix, vector = self._normal_equations(1.0)
        residual_m = self.residual_m()
        square, count = float((self.weight * residual_m**2).sum()), 2.0 * float(self.weight.sum())
        best, chosen = -np.inf, self.scales
        for noise in SCALE_FACTORS if self.known_noise_m is None else [self.known_noise_m / self.prior.noise_m]:
            for surface in SCALE_FACTORS:
                scales = _Scales(noise * self.prior.noise_m, surface * self.prior.surface_m)
                # The Jacobian of a parameter scales with its prior sigma.
                scale_ratio = scales.parameter_sigma(self.prior) / self.parameter_sigma
                precision = matrix * np.outer(scale_ratio, scale_ratio) / scales.noise_m**2 + np.eye(PARAMETER_COUNT)
                z = self.z / scale_ratio
                gradient = vector * scale_ratio / scales.noise_m**2 - z
                root = np.linalg.cholesky(precision)
                gain = np.linalg.solve(root, gradient)
                log_probability = -0.5 * (square / scales.noise_m**2 + z @ z - gain @ gain)
                log_probability -= count * log(scales.noise_m) + float(np.log(np.diag(root)).sum())
                log_probability -= 0.5 * (log(surface) / SURFACE_LOG_SIGMA) ** 2
                log_probability -= 0.5 * (log(noise) / NOISE_LOG_SIGMA) ** 2
                if log_probability > best:
                    best, chosen = log_probability, scales
        self.z = self.z * self.parameter_sigma / chosen.parameter_sigma(self.prior)
        self.scales = chosen

    def build_result(self) -> FieldFit:
        """Return the fit, and its field with its uncertainty."""
        covariance, extent = self._covariance(), self.prior.extent
        jacobian = _jacobian(self.geometry, self.prior, self.parameter_sigma, *extent.build_grid(SIGMA_GRID_NODES))
        field = CalibratedField(
            geometry=self.geometry,
            surface_m=self.surface_coefficients_m(),
            extent=extent,
            rad_per_code=self.prior.rad_per_code,
            focal_length_m=self.prior.focal_length_m,
            sigma_grid_m=_sigma_m(jacobian, covariance).reshape(SIGMA_GRID_NODES, SIGMA_GRID_NODES),
            display=self.prior.display,
            wiring=self.prior.wiring,
        )
        return FieldFit(
            field=field,
            spots=self.spots,
            prior=self.prior,
            outlier=self.weight < 0.5,
            residual_m=self.residual_m().T.copy(),
            noise_m=self.scales.noise_m,
            surface_m=self.scales.surface_m,
            parameter_sigma=self.parameter_sigma,
            covariance=covariance,
        )


def _jacobian(
    geometry: FieldGeometry, prior: FieldPrior, parameter_sigma: FloatArray, x_code: FloatArray, y_code: FloatArray
) -> FloatArray:
    """Return the derivatives of positions at codes [n] by each parameter, m, [2, n, u]."""
    jacobian = np.zeros((2, len(x_code), PARAMETER_COUNT))
    x_rad, y_rad = ((code - CENTRE_CODE) * prior.rad_per_code for code in (x_code, y_code))
    jacobian[:, :, :GEOMETRY_COUNT] = compute_parameter_derivatives(geometry, prior.sigma, x_rad, y_rad)
    surface = evaluate_terms(prior.extent, x_code, y_code)
    jacobian[0, :, GEOMETRY_COUNT : GEOMETRY_COUNT + TERM_COUNT] = (
        surface * parameter_sigma[GEOMETRY_COUNT : GEOMETRY_COUNT + TERM_COUNT]
    )
    jacobian[1, :, GEOMETRY_COUNT + TERM_COUNT :] = surface * parameter_sigma[GEOMETRY_COUNT + TERM_COUNT :]
    return jacobian


def _sigma_m(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return one sigma per axis, averaged over both axes, m, [n]."""
    variance = np.einsum("anu,uv,anv->n", jacobian, covariance, jacobian, optimize=True) / 2.0
    sigma_m: FloatArray = np.sqrt(variance)
    return sigma_m


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
