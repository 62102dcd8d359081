"""JSON bodies of requests, from Python values and those of NumPy."""

import json
from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np

from optodrive.client.api_request import encode_json_body
from optodrive.core.errors import InputError

EXPECTED_VALUE = "text, a finite number, true or false, a list or an object"


def encode_body(body: Mapping[str, Any] | bytes) -> dict[str, Any]:
    """Return a JSON body as arguments of the HTTP client's `request`. Bytes are sent as they are.

    Raises InputError with the place of a value that JSON does not have, such as NaN.
    """
    if not isinstance(body, bytes):
        try:
            body = json.dumps(body, allow_nan=False, default=_convert).encode()
        except (TypeError, ValueError, RecursionError):
            raise _build_error(body) from None
    return encode_json_body(body)


def _convert(value: object) -> object:
    """Return a value of NumPy, or a mapping, as JSON has it. Raise TypeError for any other."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError


def _build_error(body: object) -> InputError:
    try:
        return _find_error(body, "body") or InputError("body", type(body).__name__, EXPECTED_VALUE)
    except RecursionError:
        return InputError("body", "deeper nesting", "objects and lists at most 4 deep")


def _find_error(value: object, where: str) -> InputError | None:
    """Return the error of the first value that JSON does not have, None if there is none."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        for key in value:
            if not (key is None or isinstance(key, str | int | float)):
                return InputError(where, key, "keys of text")
        items = [(item, f"{where}{': ' if where == 'body' else '.'}{key}") for key, item in value.items()]
    elif isinstance(value, list | tuple):
        items = [(item, f"{where}[{index}]") for index, item in enumerate(value)]
    elif value is None or isinstance(value, str | int) or (isinstance(value, float) and isfinite(value)):
        return None
    else:
        return InputError(where, value, EXPECTED_VALUE)
    errors = (_find_error(item, place) for item, place in items)
    return next((error for error in errors if error is not None), None)
