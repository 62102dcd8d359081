"""Regressions over folds of samples."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from optodrive.lab.discovery.screening import _held_loss


@given(st.integers(0, 10_000), st.floats(1e-3, 1e3))
def test_a_parameter_that_fitted_folds_hardly_show_predicts_nothing_elsewhere(seed, size):
    """Its products in these are differences of equal sums, of which rounding leaves anything small."""
    random = np.random.default_rng(seed)
    table = random.standard_normal((4, 50, 4))
    table[1:, :, 1] *= 1e-20
    table[0, :, 1] *= size
    grams = np.einsum("fmi,fmj->fij", table, table)
    total = grams.sum(axis=0)
    rest = np.ix_([0, 2, 3], [0, 2, 3])
    without = _held_loss((total - grams[0])[rest], grams[0][rest], 1, 1, None)
    assert not _held_loss(total - grams[0], grams[0], 2, 1, None) < 0.5 * without  # nor is it a warning
