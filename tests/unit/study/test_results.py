"""Intervals and lines of results, against independent computations."""

import numpy as np
import pytest
from scipy.stats import binomtest, linregress

from optodrive.study.results import Accuracy, fit_magnitudes
from optodrive.study.study_file import load_study


@pytest.mark.parametrize(("correct", "trials"), [(200, 200), (341, 360), (0, 30), (1, 2), (353, 450)])
def test_the_interval_is_that_of_clopper_and_pearson(correct, trials):
    expected = binomtest(correct, trials).proportion_ci(0.95, "exact")
    assert Accuracy(correct, trials).interval == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_a_line_is_fitted_to_normalised_geometric_means():
    study, rng = load_study("experiment-4"), np.random.default_rng(1)
    sessions = [
        [
            {"condition": {"level": level}, "answer": float(scale * (0.1 + 0.08 * level) * rng.uniform(0.8, 1.25))}
            for level in range(1, 10)
            for _ in range(8)
        ]
        for scale in (0.5, 1.0)
    ]
    line = fit_magnitudes(study, sessions)
    means = [
        [np.exp(np.mean([np.log(r["answer"]) for r in one if r["condition"]["level"] == k])) for k in range(1, 10)]
        for one in sessions
    ]
    values = np.array([np.divide(one, np.exp(np.mean(np.log(one)))) for one in means])
    expected = linregress(np.arange(1, 10), values.mean(axis=0))
    assert (line.slope, line.intercept) == pytest.approx((expected.slope, expected.intercept))
    assert line.r_squared == pytest.approx(expected.rvalue**2)
    assert line.participants_r_squared < line.r_squared
