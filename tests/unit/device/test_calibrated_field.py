import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hidden_field import CODE_M, CONFIG, PRIOR, grid_codes, measure_spots
from optodrive.core.errors import InputError
from optodrive.device.calibrated_field import load_field
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.field_output import write_field
from optodrive.link.simulator.true_geometry import GroundTruthGeometry

FIT = fit_field(measure_spots(GroundTruthGeometry.sample(0, CONFIG), grid_codes(9), np.random.default_rng(0))[0], PRIOR)
FIELD = FIT.field
CODE = st.floats(0.0, 65535.0)


@given(CODE, CODE)
def test_codes_to_metres_and_back_within_a_tenth_of_a_code(x_code, y_code):
    back = FIELD.codes(*FIELD.position_m(x_code, y_code))
    edge = min(x_code, y_code, 65535.0 - x_code, 65535.0 - y_code) < 0.1
    assert np.hypot(back[0] - x_code, back[1] - y_code) < 0.1 or (edge and np.isnan(back[0]))


@given(st.floats(-0.04, 0.04), st.floats(-0.04, 0.04))
def test_metres_to_codes_and_back(x_m, y_m):
    again = FIELD.position_m(*FIELD.codes(x_m, y_m))
    assert np.hypot(again[0] - x_m, again[1] - y_m) < 0.1 * CODE_M


def test_any_shape_and_more_than_a_block():
    x_m = np.linspace(-0.03, 0.03, 20_000).reshape(2, 100, 100)
    x_code, y_code = FIELD.codes(x_m, 0.01)
    assert x_code.shape == y_code.shape == x_m.shape
    assert FIELD.codes(float(x_m[1, 50, 7]), 0.01) == pytest.approx((x_code[1, 50, 7], y_code[1, 50, 7]), abs=1e-6)


def test_what_no_code_reaches_is_not_a_number():
    assert np.isnan(FIELD.codes(np.array([0.2, -0.09, 1e3]), np.array([0.0, 0.09, 1e3]))).all()


def test_far_places_are_never_taken_for_others():
    """The initial guess folds over far outside. Every code that is returned leads to its position."""
    far_m = np.random.default_rng(3).uniform(-1.0, 1.0, (2, 4000))
    for seed in range(6):
        spots, _ = measure_spots(GroundTruthGeometry.sample(seed, CONFIG), grid_codes(5), np.random.default_rng(0))
        field = fit_field(spots, PRIOR).field
        for beyond, max_codes in ((False, 0.1), (True, 10.0)):
            codes = np.array(field.codes(*far_m, extrapolate=beyond))
            kept = np.isfinite(codes[0])
            assert kept.any()
            again = np.array(field.position_m(*codes[:, kept]))
            assert np.abs(again - far_m[:, kept]).max() < max_codes * CODE_M


def test_angles_are_codes_in_the_converter_s_scale():
    x_code, _ = FIELD.codes(0.01, 0.02)
    assert FIELD.angles_rad(0.01, 0.02)[0] == pytest.approx((x_code - 32768) * CONFIG.scanner.rad_per_code)


def test_there_and_back_through_a_file(tmp_path):
    write_field(tmp_path / "field.toml", FIT, 'spots "of" today')
    again = load_field(tmp_path / "field.toml")
    codes = grid_codes(7).T
    assert np.array_equal(again.position_m(*codes), FIELD.position_m(*codes))
    assert again.sigma_m(*codes) == pytest.approx(FIELD.sigma_m(*codes), rel=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("version = 1", "version = 2", "version"),
        ("optodrive-field", "optodrive-config", "format"),
        ("gain_x = ", "gian_x = ", "gian_x"),
        ("order = 6", "order = 5", "surface.order"),
        ("focal_length_m = 0.22", "focal_length_m = -1.0", "focal_length_m"),
        ("x_half", "half", "half"),
        ("gain_y = ", "gain_y = nan #", "gain_y"),
    ],
)
def test_another_file_is_refused_by_name(tmp_path, old, new, named):
    path = tmp_path / "field.toml"
    write_field(path, FIT)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=named):
        load_field(path)
