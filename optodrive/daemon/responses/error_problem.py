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

STATUS_BY_ERROR: tuple[tuple[type[OptodriveError], int, str], ...] = (
    (InputError, 422, "Invalid input"),
    (BusyError, 503, "Too busy"),
    (RefusedError, 409, "Refused"),
    (NotReadyError, 409, "Not ready"),
    (BoardFaultError, 409, "Board fault"),
    (LinkError, 503, "No link to the board"),
)
"""HTTP status and title of a problem by the error's class, the first that fits."""
NOT_FOUND_CODES = ("plan_not_found", "unknown_pattern")


def build_error_problem(error: OptodriveError) -> Problem:
    """Build the problem document of an error of this package."""
    found = ((status, title) for kind, status, title in STATUS_BY_ERROR if isinstance(error, kind))
    status, title = next(found, (500, "Internal error"))
    if error.code in NOT_FOUND_CODES:
        status, title = 404, "Not found"
    extensions: dict[str, Any] = {}
    if isinstance(error, InputError):
        extensions = {"where": error.where, "value": abbreviate(error.value), "expected": error.expected}
    if isinstance(error, OverBudgetError):
        fits_after_s = error.fits_after_s if error.fits_after_s < inf else None
        extensions = {"pixel": error.pixel, "cap": error.cap, "margin_j": error.margin_j, "fits_after_s": fits_after_s}
    if isinstance(error, RefusedError) and error.feasibility is not None:
        extensions["feasibility"] = error.feasibility
    return build_problem(status, error.code, title, str(error), **extensions)
