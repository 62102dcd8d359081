"""Problem documents for the errors of this package."""

from math import inf
from typing import Any

from optodrive.core.errors import (
    BoardFaultError,
    BusyError,
    InputError,
    LinkError,
    NotReadyError,
    OptodriveError,
    OverBudgetError,
    RefusedError,
    abbreviate,
)
from optodrive.daemon.responses.problem import Problem, build_problem

STATUS_BY_ERROR: tuple[tuple[type[OptodriveError], int], ...] = (
    (InputError, 422),
    (BusyError, 503),
    (RefusedError, 409),
    (NotReadyError, 409),
    (BoardFaultError, 409),
    (LinkError, 503),
)
NOT_FOUND_CODES = ("plan_not_found", "unknown_pattern")


def build_error_problem(error: OptodriveError) -> Problem:
    """Build the problem document of an error of this package."""
    status = next((status for kind, status in STATUS_BY_ERROR if isinstance(error, kind)), 500)
    if error.code in NOT_FOUND_CODES:
        status = 404
    extensions: dict[str, Any] = {}
    if isinstance(error, InputError):
        extensions = {"where": error.where, "value": abbreviate(error.value), "expected": error.expected}
    if isinstance(error, OverBudgetError):
        fits_after_s = error.fits_after_s if error.fits_after_s < inf else None
        extensions = {"pixel": error.pixel, "cap": error.cap, "margin_j": error.margin_j, "fits_after_s": fits_after_s}
    if isinstance(error, RefusedError) and error.feasibility is not None:
        extensions["feasibility"] = error.feasibility
    return build_problem(status, error.code, type(error).__name__.removesuffix("Error"), str(error), **extensions)
