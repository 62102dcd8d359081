"""Results of requests to the link process: an error as fields of a message, and the error again at the caller."""

from typing import Any

from optodrive.core import errors
from optodrive.core.errors import OptodriveError
from optodrive.core.ipc import Message


def build_result(request_id: int, error: OptodriveError | None, fields: dict[str, Any]) -> Message:
    """Return the result of a request.

    error: None if it was carried out; fields: further fields
    """
    error_fields = None
    if error is not None:
        error_fields = {"code": error.code, "message": str(error), "type": type(error).__name__}
    return Message("result", {"id": request_id, "error": error_fields, **fields})


def build_error(fields: dict[str, Any]) -> OptodriveError:
    """Return the error of a result, of its own type if that needs nothing but a message."""
    kind = getattr(errors, str(fields["type"]), OptodriveError)
    if not (isinstance(kind, type) and issubclass(kind, OptodriveError)) or kind.__init__ is not Exception.__init__:
        kind = OptodriveError
    error: OptodriveError = kind(fields["message"])
    error.code = fields["code"]
    return error
