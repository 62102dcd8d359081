"""The fit is judged by normal equations, by grids and by sampling."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optodrive.lab.inference.fit import Prior, fit_residuals

T_S = np.linspace(0.0, 2.0, 60)


def decay(x):
    return x[0] * np.exp(-T_S / x[1]) + x[2]


def misfit(data, sigma=0.01):
    return lambda x: (data - decay(x)) / sigma


WIDE = np.array([-10.0, 1e-2, -10.0]), np.array([10.0, 10.0, 10.0])


@settings(deadline=None)
@given(st.integers(0, 10**6))
def test_a_linear_problem_within_bounds_is_solved_like_its_normal_equations(seed):
    random = np.random.default_rng(seed)
    matrix, y = random.standard_normal((20, 3)), random.standard_normal(20)
    mean, sigma = random.standard_normal(3), np.array([0.3, np.inf, 1.0])
    bounds = np.full(3, -1e3), np.full(3, 1e3)
    found = fit_residuals(lambda x: y - matrix @ x, np.zeros(3), bounds, 1e-4, prior=Prior(mean, sigma))
    hessian = matrix.T @ matrix + np.diag(sigma**-2)
    expected = np.linalg.solve(hessian, matrix.T @ y + mean / sigma**2)
    assert found.x == pytest.approx(expected, abs=1e-6)
    assert found.covariance == pytest.approx(np.linalg.inv(hessian), rel=1e-5, abs=1e-9)
    assert found.residual == pytest.approx(y - matrix @ expected, abs=1e-5)
    prior_terms = (((found.x - mean) / sigma) ** 2).sum()
    assert found.chi2 == pytest.approx((found.residual**2).sum() + prior_terms, rel=1e-9)


def test_the_stated_deviation_is_that_of_many_fits():
    random, truth, found = np.random.default_rng(1), np.array([1.0, 0.5, 0.2]), []
    for _ in range(200):
        data = decay(truth) + 0.01 * random.standard_normal(len(T_S))
        found.append(fit_residuals(misfit(data), np.array([0.5, 1.0, 0.0]), WIDE, 1e-6))
    scatter = np.std([each.x for each in found], axis=0)
    assert scatter == pytest.approx(found[0].sigma, rel=0.2)


@pytest.mark.parametrize("method", ["trf", "dogbox"])
def test_a_bound_holds_and_the_rest_fits_beside_it(method):
    data = decay([1.0, 0.5, 0.2])
    low, high = WIDE[0], np.array([10.0, 0.4, 10.0])
    found = fit_residuals(misfit(data), np.array([0.5, 0.1, 0.0]), (low, high), 1e-6, method=method)
    assert found.x[1] == pytest.approx(0.4, abs=1e-4)
    columns = np.column_stack([np.exp(-T_S / 0.4), np.ones(len(T_S))])
    assert found.x[[0, 2]] == pytest.approx(np.linalg.lstsq(columns, data, rcond=None)[0], abs=1e-3)


def test_no_parameter_leaves_its_bounds_while_it_is_differentiated():
    tried = []

    def residual(x):
        tried.append(x)
        return misfit(decay([1.0, 0.5, 0.2]))(x)

    low, high = np.array([0.0, 0.3, 0.0]), np.array([0.8, 0.45, 0.1])
    fit_residuals(residual, high.copy(), (low, high), 1e-2, method="dogbox")
    assert (np.array(tried) >= low).all()
    assert (np.array(tried) <= high).all()


def test_fixed_parameters_stay_and_have_no_covariance():
    data, free = decay([1.0, 0.5, 0.2]), np.array([True, False, True])
    found = fit_residuals(misfit(data), np.array([0.5, 0.6, 0.0]), WIDE, 1e-6, free=free)
    assert found.x[1] == 0.6
    assert not found.covariance[1].any()
    none = fit_residuals(misfit(data), np.array([0.5, 0.6, 0.0]), WIDE, 1e-6, free=np.zeros(3, bool))
    assert none.x.tolist() == [0.5, 0.6, 0.0]
    assert none.chi2 == pytest.approx((misfit(data)(none.x) ** 2).sum())
