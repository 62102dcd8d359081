"""Ground-truth beam geometry of a simulated display: ray tracing over two mirrors, a lens and the display plane.

Calibrations have no access to it. The laser runs along +x to mirror x, which is `mirror_spacing_m` from mirror y along
+y and rotates about z; mirror y rotates about x and deflects the beam along +z through the lens to the display.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from optodrive.core.types.arrays import FloatArray, ReadOnlyArrays
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.config_sections import HALF_RANGE_CODES

CENTRE_CODE = HALF_RANGE_CODES + 1
HALF_FIELD_MIN_M = 0.01
"""Minimum half-width of the field over which the deviations are scaled."""
WAVE_COUNT = 3
MAX_ERROR_RANGE_M = (0.5e-3, 3.0e-3)
"""Range of the maximum error of the uncorrected beam over the display; sampling repeats until it is met."""
SAMPLES_MAX = 1000
"""Number of samples from which the nearest to that range is taken where a large display or a short lens meets none."""


@dataclass(frozen=True, eq=False)
class GroundTruthGeometry(ReadOnlyArrays):
    """One geometry. Arrays [2] hold x and y.

    nominal_rad_per_code, range_rad: of the DAC; gain, offset_rad, cross, cubic: command to steady mirror angle,
    cross from the other axis, cubic relative at the end of the range
    lens_coefficients_m: f1, f3, f5 of r = f1 θ + f3 θ³ + f5 θ⁵; focal_length_m: distance of its focal plane
    lens_position_m: distance from mirror y; display_origin_m: the display's origin in the focal plane
    display_axes: [3, 3], rows are its x, y and normal
    wave_rad, wave_phase, wave_m: [2, WAVE_COUNT, 2], [2, WAVE_COUNT], [2, WAVE_COUNT] unmodelled deviation as cosines
    over the mirror angles
    """

    nominal_rad_per_code: float
    range_rad: float
    mirror_spacing_m: float
    gain: FloatArray
    offset_rad: FloatArray
    cross: FloatArray
    cubic: FloatArray
    lens_coefficients_m: FloatArray
    focal_length_m: float
    lens_position_m: float
    display_origin_m: FloatArray
    display_axes: FloatArray
    wave_rad: FloatArray
    wave_phase: FloatArray
    wave_m: FloatArray

    @classmethod
    def sample(cls, seed: int, config: Config) -> Self:
        """Sample a geometry within assembly tolerances of the configuration, reproducible by seed."""
        random = np.random.default_rng(seed)
        layout = build_pixel_layout(config.display)
        twice_f_m = 2.0 * config.scanner.focal_length_m
        step_rad = config.scanner.rad_per_code
        codes = CENTRE_CODE + np.array([layout.x_m, layout.y_m]) / (twice_f_m * step_rad)
        sampled: list[tuple[float, Self]] = []
        for _ in range(SAMPLES_MAX):
            geometry = cls._sample_once(random, config)
            x_m, y_m = geometry.position_m(codes[0], codes[1])
            max_error_m = float(np.hypot(x_m - layout.x_m, y_m - layout.y_m).max())
            if MAX_ERROR_RANGE_M[0] <= max_error_m <= MAX_ERROR_RANGE_M[1]:
                return geometry
            sampled.append((max(MAX_ERROR_RANGE_M[0] - max_error_m, max_error_m - MAX_ERROR_RANGE_M[1]), geometry))
        return min(sampled, key=lambda item: item[0])[1]

    @classmethod
    def _sample_once(cls, random: np.random.Generator, config: Config) -> Self:
        layout, scanner = build_pixel_layout(config.display), config.scanner
        half_field_m = max(HALF_FIELD_MIN_M, float(np.abs([layout.x_m, layout.y_m]).max()))
        edge_rad = np.hypot(half_field_m, half_field_m) / scanner.focal_length_m
        focal_m = scanner.focal_length_m * (1.0 + random.uniform(-0.005, 0.005))
        distortion = random.uniform(-1.0, 1.0, 2) * [3e-3, 1e-3] / edge_rad ** np.array([2, 4])
        rotation, tilt_x, tilt_y = np.radians(random.uniform(-1.0, 1.0, 3))
        orientation = _rotation_matrix(2, rotation) @ _rotation_matrix(0, tilt_x) @ _rotation_matrix(1, tilt_y)
        angle = random.uniform(0.0, 2.0 * np.pi, (2, WAVE_COUNT))
        # One to two field lengths per wave.
        waves_per_field = random.uniform(0.5, 1.0, (2, WAVE_COUNT))
        half_rad = half_field_m / (2.0 * scanner.focal_length_m)
        weights = random.uniform(0.3, 1.0, (2, WAVE_COUNT))
        peak_m = random.uniform(20e-6, 40e-6, (2, 1))
        return cls(
            nominal_rad_per_code=scanner.rad_per_code,
            range_rad=scanner.range_rad,
            mirror_spacing_m=random.uniform(8e-3, 20e-3),
            gain=1.0 + random.uniform(-0.01, 0.01, 2),
            offset_rad=random.uniform(-1e-3, 1e-3, 2),
            cross=random.uniform(-5e-3, 5e-3, 2),
            cubic=random.uniform(-2e-3, 2e-3, 2),
            lens_coefficients_m=focal_m * np.array([1.0, *distortion]),
            focal_length_m=focal_m,
            lens_position_m=random.uniform(0.03, 0.06),
            display_origin_m=random.uniform(-1e-3, 1e-3, 2),
            display_axes=orientation.T,
            wave_rad=(np.pi / half_rad * waves_per_field)[..., None]
            * np.stack([np.cos(angle), np.sin(angle)], axis=-1),
            wave_phase=random.uniform(0.0, 2.0 * np.pi, (2, WAVE_COUNT)),
            wave_m=peak_m * weights / weights.sum(axis=1, keepdims=True),
        )

    def mirror_angles_rad(self, x_code: ArrayLike, y_code: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the steady mechanical mirror angles of codes of any shape, integer or not."""
        codes = np.array(np.broadcast_arrays(x_code, y_code), dtype=np.float64) - CENTRE_CODE
        command_rad = codes * self.nominal_rad_per_code
        gain, offset_rad, cross, cubic = (
            coefficient.reshape(2, *[1] * (codes.ndim - 1))
            for coefficient in (self.gain, self.offset_rad, self.cross, self.cubic)
        )
        scaled_rad = gain * command_rad * (1.0 + cubic * (command_rad / self.range_rad) ** 2)
        x_rad, y_rad = scaled_rad + cross * command_rad[::-1] + offset_rad
        return x_rad, y_rad

    def landing_point_m(self, x_rad: ArrayLike, y_rad: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the beam's landing point in the display's axes, m, for mirror angles of any shape."""
        mirror_rad = np.array(np.broadcast_arrays(x_rad, y_rad), dtype=np.float64)
        start, direction = self._trace_mirrors(*mirror_rad)
        at_lens = start + direction * ((self.lens_position_m - start[2]) / direction[2])
        field_angle_rad = np.arctan2(np.hypot(direction[0], direction[1]), direction[2])
        f1, f3, f5 = self.lens_coefficients_m
        radius_m = field_angle_rad * (f1 + f3 * field_angle_rad**2 + f5 * field_angle_rad**4)
        transverse = np.maximum(np.hypot(direction[0], direction[1]), np.finfo(np.float64).tiny)
        in_focus = np.stack(
            [
                radius_m * direction[0] / transverse,
                radius_m * direction[1] / transverse,
                np.full(transverse.shape, self._focal_plane_m),
            ]
        )
        origin = np.array([*self.display_origin_m, self._focal_plane_m]).reshape(3, *[1] * (mirror_rad.ndim - 1))
        normal = self.display_axes[2]
        lens_to_focus = in_focus - at_lens
        fraction = np.tensordot(normal, origin - at_lens, 1) / np.tensordot(normal, lens_to_focus, 1)
        x_m, y_m = np.tensordot(self.display_axes[:2], at_lens + fraction * lens_to_focus - origin, 1)
        dx_m, dy_m = self._deviation_m(mirror_rad)
        return x_m + dx_m, y_m + dy_m

    def position_m(self, x_code: ArrayLike, y_code: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the beam's landing point on the display, m, float64, for codes of any shape, integer or not."""
        return self.landing_point_m(*self.mirror_angles_rad(x_code, y_code))

    @property
    def _focal_plane_m(self) -> float:
        return self.lens_position_m + self.focal_length_m

    def _trace_mirrors(self, x_rad: FloatArray, y_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return a point [3, ...] on mirror y and the direction [3, ...] of the beam after it."""
        zero = np.zeros_like(x_rad)
        x_angle, y_angle = 0.25 * np.pi + x_rad, 0.25 * np.pi - y_rad
        x_normal = np.stack([-np.cos(x_angle), -np.sin(x_angle), zero])
        y_normal = np.stack([zero, np.cos(y_angle), np.sin(y_angle)])
        incident = np.stack([zero + 1.0, zero, zero])
        intermediate = _reflect(incident, x_normal)
        first = np.stack([zero, zero + self.mirror_spacing_m, zero])
        length = -(first * y_normal).sum(axis=0) / (intermediate * y_normal).sum(axis=0)
        return first + intermediate * length, _reflect(intermediate, y_normal)

    def _deviation_m(self, mirror_rad: FloatArray) -> FloatArray:
        """Return the unmodelled deviation, [2, ...], m."""
        phase = np.tensordot(self.wave_rad, mirror_rad, 1)
        shape = (2, WAVE_COUNT, *[1] * (mirror_rad.ndim - 1))
        waves = self.wave_m.reshape(shape) * np.cos(phase + self.wave_phase.reshape(shape))
        deviation_m: FloatArray = waves.sum(axis=1)
        return deviation_m


def _reflect(direction: FloatArray, normal: FloatArray) -> FloatArray:
    """Reflect directions at plane mirrors. Directions and unit normals are [3, ...]."""
    mirrored: FloatArray = direction - 2.0 * (direction * normal).sum(axis=0) * normal
    return mirrored


def _rotation_matrix(axis: int, angle_rad: float) -> FloatArray:
    """Return the rotation matrix about an axis, [3, 3]."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle_rad)
    matrix[first, second], matrix[second, first] = -np.sin(angle_rad), np.sin(angle_rad)
    return matrix
