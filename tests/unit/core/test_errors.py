"""Errors between processes: a pool's parent raises the error that a worker has raised."""

import pickle

import pytest

from optodrive.core import errors

RAISED = [
    errors.InputError("runs[2]: width_s", 2.0, "at most 1 s", "unit"),
    errors.OverBudgetError("too hot", 7, "wall", 0.25, 1.5),
    errors.LinkError("the board does not answer"),
]


@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_an_error_is_the_same_in_another_process(error):
    arrived = pickle.loads(pickle.dumps(error))
    assert (type(arrived), str(arrived), vars(arrived)) == (type(error), str(error), vars(error))
