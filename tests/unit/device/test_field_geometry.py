import numpy as np
import pytest

from hidden_field import CONFIG, PRIOR
from optodrive.device.field_geometry import (
    FieldGeometry,
    beam_position_m,
    build_display_axes,
    compute_parameter_derivatives,
)
from optodrive.link.simulator.true_geometry import GroundTruthGeometry, _rotation_matrix

TRUTH = GroundTruthGeometry.sample(5, CONFIG)
SAME = FieldGeometry(
    gain_x=TRUTH.gain[0],
    gain_y=TRUTH.gain[1],
    offset_x_rad=TRUTH.offset_rad[0],
    offset_y_rad=TRUTH.offset_rad[1],
    cross_x=TRUTH.cross[0],
    cross_y=TRUTH.cross[1],
    cubic_x_per_rad2=TRUTH.cubic[0] / TRUTH.range_rad**2,
    cubic_y_per_rad2=TRUTH.cubic[1] / TRUTH.range_rad**2,
    mirror_distance_m=TRUTH.mirror_spacing_m,
    lens_distance_m=TRUTH.lens_position_m,
    focal_length_m=TRUTH.lens_coefficients_m[0],
    distortion3_per_rad2=TRUTH.lens_coefficients_m[1] / TRUTH.lens_coefficients_m[0],
    distortion5_per_rad4=TRUTH.lens_coefficients_m[2] / TRUTH.lens_coefficients_m[0],
    shift_x_m=TRUTH.display_origin_m[0],
    shift_y_m=TRUTH.display_origin_m[1],
    turn_rad=0.01,
    tilt_x_rad=-0.012,
    tilt_y_rad=0.008,
)


def test_closed_forms_agree_with_rays_traced_by_other_code():
    axes = (
        _rotation_matrix(2, SAME.turn_rad) @ _rotation_matrix(0, SAME.tilt_x_rad) @ _rotation_matrix(1, SAME.tilt_y_rad)
    ).T
    assert np.allclose(build_display_axes(SAME), axes, atol=1e-15)
    table = {name: getattr(TRUTH, name) for name in TRUTH.__dataclass_fields__}
    traced = GroundTruthGeometry(**(table | {"display_axes": axes, "wave_m": np.zeros_like(TRUTH.wave_m)}))
    x_code, y_code = np.random.default_rng(0).uniform(2000, 63000, (2, 500))
    scale = PRIOR.rad_per_code
    closed = beam_position_m(SAME, (x_code - 32768) * scale, (y_code - 32768) * scale)
    assert np.allclose(closed, traced.position_m(x_code, y_code), atol=1e-9)


def test_derivatives_are_slopes():
    x_rad, y_rad = np.random.default_rng(1).uniform(-0.08, 0.08, (2, 20))
    slopes = compute_parameter_derivatives(SAME, PRIOR.sigma, x_rad, y_rad)
    for index in range(len(SAME)):
        moved = FieldGeometry(*(value + 1e-2 * PRIOR.sigma[at] * (at == index) for at, value in enumerate(SAME)))
        by = np.subtract(beam_position_m(moved, x_rad, y_rad), beam_position_m(SAME, x_rad, y_rad)) / 1e-2
        assert slopes[:, :, index] == pytest.approx(by, rel=2e-2, abs=1e-7)


def test_nominally_the_beam_goes_where_an_ideal_lens_sends_it_along_an_axis():
    x_m, y_m = beam_position_m(PRIOR.mean, np.array([0.05, 0.0]), np.array([0.0, 0.05]))
    assert x_m == pytest.approx([0.1 * PRIOR.focal_length_m, 0.0], abs=1e-9)
    assert y_m == pytest.approx([0.0, 0.1 * PRIOR.focal_length_m], abs=1e-9)
