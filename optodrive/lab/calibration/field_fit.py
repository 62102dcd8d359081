"""Spots to a field: the most probable geometry and surface, false detections told apart, and how sure all of it is.

Unknowns are counted in units of their prior's width: z = 0 is what one expected, and every prior is one.
"""

from dataclasses import dataclass
from math import log, pi

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, freeze_arrays
from optodrive.device.calibrated_field import Field
from optodrive.device.field_geometry import CENTRE_CODE, Geometry, by_parameters, lands_m
from optodrive.device.field_surface import ORDER, TERMS, spread, terms
from optodrive.lab.calibration.field_prior import Prior
from optodrive.lab.calibration.spots import Spots

PHYSICAL = len(Geometry._fields)
UNKNOWNS = PHYSICAL + 2 * TERMS
START_M = (3e-3, 1e-3, 0.3e-3, 0.1e-3, 0.05e-3)
"""A spot counts for as much as a noise of this width lets it, ever narrower: first all may be wrong, then few are."""
STEPS = 4
ROUNDS = 6
EXPECTED_FALSE = 0.02
CAUTION = 10.0
"""The expected share of false detections counts as so many spots seen before."""
TRIED: list[float] = np.geomspace(1.0 / 8.0, 8.0, 13).tolist()
"""Noise and surface are looked for at these multiples of what is expected."""
NOISE_SPREAD, SURFACE_SPREAD = 0.7, 0.5
"""Natural logarithms by which noise and surface may be off what is expected, one sigma."""
SIGMA_GRID = 17


@dataclass(frozen=True, eq=False)
class FieldFit:
    """A field and how it came about.

    outlier: [n] taken for false; residual_m: [n, 2] measured less fitted; noise_m, surface_m: rms on an axis, fitted
    covariance: [u, u] of all unknowns in units of `width` [u]
    """

    field: Field
    spots: Spots
    prior: Prior
    outlier: BoolArray
    residual_m: FloatArray
    noise_m: float
    surface_m: float
    surface_order: int
    width: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals' lengths, false detections left out; NaN without spots."""
        kept = self.residual_m[~self.outlier]
        return float(np.sqrt((kept**2).sum(axis=1).mean())) if len(kept) else float("nan")

    def derivatives_m(self, x_code: FloatArray, y_code: FloatArray) -> FloatArray:
        """How places at codes [n] move with each unknown, [2, n, u]."""
        return _derivatives(self.field.geometry, self.prior, self.width, x_code, y_code)


@dataclass(frozen=True)
class _Scales:
    """noise_m: of a spot; surface_m: rms of the surface; either on an axis."""

    noise_m: float
    surface_m: float

    def width(self, prior: Prior) -> FloatArray:
        return np.concatenate([prior.width, np.tile(self.surface_m * spread(), 2)])


def fit_field(spots: Spots, prior: Prior, noise_m: float | None = None) -> FieldFit:
    """The most probable field of spots, few or many or none; noise_m: of a spot on an axis, fitted where not given."""
    fitted = _Fit(spots, prior, noise_m)
    fitted.start()
    for _ in range(ROUNDS):
        before = fitted.weight.copy()
        fitted.settle()
        fitted.weigh_scales()
        fitted.judge()
        if np.array_equal(before, fitted.weight):
            break
    fitted.settle()
    return fitted.result()


class _Fit:
    """z: [u] the unknowns in units of their width; weight: [n] of each spot, 0 to 1."""

    def __init__(self, spots: Spots, prior: Prior, noise_m: float | None) -> None:
        self.spots, self.prior, self.given_m = spots, prior, noise_m
        self.scales = _Scales(noise_m or prior.noise_m, prior.surface_m)
        self.z = np.zeros(UNKNOWNS)
        self.weight = np.ones(len(spots))
        self.false_share = EXPECTED_FALSE
        self.terms = terms(prior.extent, spots.x_code, spots.y_code)
        self.measured_m = np.stack([spots.x_m, spots.y_m])

    @property
    def width(self) -> FloatArray:
        return self.scales.width(self.prior)

    @property
    def geometry(self) -> Geometry:
        return Geometry(*(np.array(self.prior.mean) + self.z[:PHYSICAL] * self.prior.width).tolist())

    def surface_m(self) -> FloatArray:
        coefficients: FloatArray = (self.z[PHYSICAL:] * self.width[PHYSICAL:]).reshape(2, TERMS)
        return coefficients

    def angles_rad(self) -> FloatArray:
        codes = np.stack([self.spots.x_code, self.spots.y_code])
        return (codes - CENTRE_CODE) * self.prior.rad_per_code

    def residual_m(self) -> FloatArray:
        """Measured less fitted, [2, n]."""
        left: FloatArray = (
            self.measured_m - np.stack(lands_m(self.geometry, *self.angles_rad())) - self.surface_m() @ self.terms.T
        )
        return left

    def _normal(self, noise_m: float) -> tuple[FloatArray, FloatArray]:
        """Of the linearised problem without its prior: [u, u] and [u]."""
        slope = _derivatives(self.geometry, self.prior, self.width, self.spots.x_code, self.spots.y_code)
        weighted = slope * (self.weight / noise_m**2)[None, :, None]
        return np.tensordot(weighted, slope, ([0, 1], [0, 1])), np.tensordot(
            weighted, self.residual_m(), ([0, 1], [0, 1])
        )

    def step(self, noise_m: float) -> None:
        """One of Gauss and Newton; the problem is so nearly linear that none is too long."""
        matrix, vector = self._normal(noise_m)
        step = np.linalg.solve(matrix + np.eye(UNKNOWNS), vector - self.z)
        self.z = np.asarray(self.z + step, dtype=np.float64)

    def start(self) -> None:
        """From the nominal geometry, first with all spots under suspicion."""
        for scale_m in START_M:
            for _ in range(STEPS):
                self.weight = self._true_share(scale_m)
                self.step(scale_m)
        self.judge()

    def settle(self) -> None:
        """To the most probable unknowns for weights and scales as they are."""
        for _ in range(STEPS):
            self.step(self.scales.noise_m)

    def _true_share(self, scale_m: float | FloatArray) -> FloatArray:
        """How probably each spot is a true one, with a noise so wide."""
        distance2 = (self.residual_m() ** 2).sum(axis=0)
        true = (1.0 - self.false_share) * np.exp(-0.5 * distance2 / scale_m**2) / (2.0 * pi * scale_m**2)
        share: FloatArray = true / (true + self.false_share / self.prior.field_m2)
        return share

    def judge(self) -> None:
        """Each spot true or false, by what is left of it and by how sure the field is there."""
        scale_m = np.hypot(self.scales.noise_m, self._sigma_m())
        self.weight = (self._true_share(scale_m) > 0.5).astype(np.float64)
        false = len(self.weight) - self.weight.sum()
        self.false_share = float((false + CAUTION * EXPECTED_FALSE) / (len(self.weight) + CAUTION))

    def _covariance(self) -> FloatArray:
        matrix, _ = self._normal(self.scales.noise_m)
        return np.asarray(np.linalg.inv(matrix + np.eye(UNKNOWNS)), dtype=np.float64)

    def _sigma_m(self) -> FloatArray:
        slope = _derivatives(self.geometry, self.prior, self.width, self.spots.x_code, self.spots.y_code)
        return _sigma_m(slope, self._covariance())

    def weigh_scales(self) -> None:
        """Noise and surface as the spots make them probable together, whatever the unknowns."""
        matrix, vector = self._normal(1.0)
        left = self.residual_m()
        square, count = float((self.weight * left**2).sum()), 2.0 * float(self.weight.sum())
        best, chosen = -np.inf, self.scales
        for noise in TRIED if self.given_m is None else [self.given_m / self.prior.noise_m]:
            for surface in TRIED:
                scales = _Scales(noise * self.prior.noise_m, surface * self.prior.surface_m)
                # Unknowns whose prior is wider move the place by as much more.
                by = scales.width(self.prior) / self.width
                precision = matrix * np.outer(by, by) / scales.noise_m**2 + np.eye(UNKNOWNS)
                z = self.z / by
                pull = vector * by / scales.noise_m**2 - z
                root = np.linalg.cholesky(precision)
                gain = np.linalg.solve(root, pull)
                probable = -0.5 * (square / scales.noise_m**2 + z @ z - gain @ gain)
                probable -= count * log(scales.noise_m) + float(np.log(np.diag(root)).sum())
                probable -= 0.5 * (log(surface) / SURFACE_SPREAD) ** 2
                probable -= 0.5 * (log(noise) / NOISE_SPREAD) ** 2
                if probable > best:
                    best, chosen = probable, scales
        self.z = self.z * self.width / chosen.width(self.prior)
        self.scales = chosen

    def result(self) -> FieldFit:
        """The fit; its field with its own uncertainty."""
        covariance, extent = self._covariance(), self.prior.extent
        slope = _derivatives(self.geometry, self.prior, self.width, *extent.grid(SIGMA_GRID))
        field = Field(
            geometry=self.geometry,
            surface_m=self.surface_m(),
            extent=extent,
            rad_per_code=self.prior.rad_per_code,
            focal_length_m=self.prior.focal_length_m,
            sigma_grid_m=_sigma_m(slope, covariance).reshape(SIGMA_GRID, SIGMA_GRID),
        )
        return FieldFit(
            field=field,
            spots=self.spots,
            prior=self.prior,
            outlier=self.weight < 0.5,
            residual_m=self.residual_m().T.copy(),
            noise_m=self.scales.noise_m,
            surface_m=self.scales.surface_m,
            surface_order=ORDER,
            width=self.width,
            covariance=covariance,
        )


def _derivatives(
    geometry: Geometry, prior: Prior, width: FloatArray, x_code: FloatArray, y_code: FloatArray
) -> FloatArray:
    """How places at codes [n] move with each unknown, [2, n, u]."""
    out = np.zeros((2, len(x_code), UNKNOWNS))
    x_rad, y_rad = ((code - CENTRE_CODE) * prior.rad_per_code for code in (x_code, y_code))
    out[:, :, :PHYSICAL] = by_parameters(geometry, prior.width, x_rad, y_rad)
    own = terms(prior.extent, x_code, y_code)
    out[0, :, PHYSICAL : PHYSICAL + TERMS] = own * width[PHYSICAL : PHYSICAL + TERMS]
    out[1, :, PHYSICAL + TERMS :] = own * width[PHYSICAL + TERMS :]
    return out


def _sigma_m(slope: FloatArray, covariance: FloatArray) -> FloatArray:
    """One sigma on an axis, of both together, [n]."""
    variance = np.einsum("anu,uv,anv->n", slope, covariance, slope, optimize=True) / 2.0
    sigma_m: FloatArray = np.sqrt(variance)
    return sigma_m
