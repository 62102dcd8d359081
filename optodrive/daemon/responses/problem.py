"""Problem documents (RFC 9457), which describe errors, and those for the errors of this package."""

from math import inf
from typing import Any

from pydantic import ConfigDict

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
from optodrive.core.json_model import JsonModel
from optodrive.planning.feasibility.report import FeasibilityReport

MEDIA_TYPE = "application/problem+json"


class Problem(JsonModel):
    """RFC 9457 problem document with a stable code.

    The members after `code` are extensions; a document has only those that its code calls for.

    where, value, expected: the wrong input, in words
    pixel, cap, margin_j, fits_after_s: the first pulse that exceeds a cap; fits_after_s is null if it never fits
    feasibility: the report on a sequence that does not fit
    retry_after_s: time until the next request is accepted; allow: the methods that the path accepts
    role, required_role: of the token, and the lowest that the route accepts
    type: URN made of the code
    title: kind of the problem in words
    status: HTTP status
    detail: the problem in one line
    code: stable name of the problem for programs
    """

    model_config = ConfigDict(json_schema_serialization_defaults_required=False)

    type: str
    title: str
    status: int
    detail: str
    code: str
    where: str | None = None
    value: str | None = None
    expected: str | None = None
    pixel: int | None = None
    cap: str | None = None
    margin_j: float | None = None
    fits_after_s: float | None = None
    feasibility: FeasibilityReport | None = None
    retry_after_s: float | None = None
    allow: str | None = None
    role: str | None = None
    required_role: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the members that the document has."""
        return self.model_dump(mode="json", exclude_unset=True)

    def to_json(self) -> bytes:
        """Encode the members that the document has."""
        return self.model_dump_json(exclude_unset=True).encode()


def build_problem(status: int, code: str, title: str, detail: str, **extensions: Any) -> Problem:
    """Build a problem document. Its type is a URN made of the code."""
    return Problem(type=f"urn:optodrive:{code}", title=title, status=status, detail=detail, code=code, **extensions)


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
