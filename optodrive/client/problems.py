"""Conversion of problem documents to this package's errors."""

from math import inf

from pydantic import ValidationError

from optodrive.core.errors import (
    BoardFaultError,
    BusyError,
    InputError,
    LinkError,
    NotReadyError,
    OptodriveError,
    OverBudgetError,
    RefusedError,
    StoppedError,
    Unquoted,
)
from optodrive.daemon.api.tokens import ENVIRONMENT_VARIABLE
from optodrive.daemon.responses.problem import Problem

INPUT_ERROR_STATUSES = (400, 404, 413, 422)
UPSTREAM_LOST = (502, 503, 504)
"""Statuses with which a proxy says that it does not reach the server behind it."""
ERROR_BY_CODE: dict[str, type[OptodriveError]] = {
    "not_ready": NotReadyError,
    "stopped": StoppedError,
    "busy": BusyError,
    "board_fault": BoardFaultError,
    "link": LinkError,
}


def parse_problem(status: int, body: bytes) -> OptodriveError:
    """Parse the body of an error response.

    Return LinkError if it is not a problem document. The daemon sends one with each error, so it came from a proxy.
    """
    try:
        problem = Problem.model_validate_json(body, extra="ignore")
    except ValidationError:
        if status in UPSTREAM_LOST:
            lost = f"a proxy answered {status}: the daemon behind it is not there"
            return LinkError(f"{lost}; is `optodrive serve` running?")
        return LinkError(f"{status} without a problem document: a proxy or another program answered, not the daemon")
    return build_error(problem)


def build_error(problem: Problem) -> OptodriveError:
    """Build the error that a problem document describes. The error keeps the document as `problem`."""
    error = _build_typed_error(problem)
    error.problem = problem.to_dict()
    error.code = problem.code
    if isinstance(error, RefusedError):
        error.feasibility = error.problem.get("feasibility")
    return error


def _build_typed_error(problem: Problem) -> OptodriveError:
    detail = problem.detail
    if problem.status == 401:
        reason = "" if problem.code == "bad_token" else f": {detail}"
        expected = f"one of this daemon's ({ENVIRONMENT_VARIABLE}, or the file that it names at its start){reason}"
        return InputError("token", Unquoted("another one"), expected)
    if problem.status in INPUT_ERROR_STATUSES:
        if problem.where is not None and problem.expected is not None:
            return InputError(problem.where, Unquoted(str(problem.value)), problem.expected)
        return InputError("request", problem.status, detail)
    if problem.pixel is not None and problem.cap is not None and problem.margin_j is not None:
        fits_after_s = inf if problem.fits_after_s is None else problem.fits_after_s
        return OverBudgetError(detail, problem.pixel, problem.cap, problem.margin_j, fits_after_s)
    return ERROR_BY_CODE.get(problem.code, RefusedError)(detail)
