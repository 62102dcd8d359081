"""Scripted fingertips: a CSV file of places with their times."""

from itertools import groupby
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from optodrive.core.errors import InputError
from optodrive.core.numeric_tables import read_columns
from optodrive.core.toml_model import build_input_error
from optodrive.core.types.fingers import FingerPlace, FingerReport
from optodrive.daemon.responses.messages import FINGERS_MAX, FingerMessage

COLUMNS = ("time_s", "number", "x_m", "y_m", "radius_m")
LIFTED_S = 0.05
"""Time after its last row at which a script that ends with fingers on the display lifts them."""


def read_finger_script(path: Path) -> list[FingerReport]:
    """Read a script. Rows of one time are one report, and at its end all fingers are lifted.

    Raises InputError that names row, column and value.
    """
    table = read_columns(path, COLUMNS)
    if not len(table):
        raise InputError(str(path), "no row", "a row for each fingertip at each time")
    backward = np.flatnonzero(np.diff(table[:, 0], prepend=0.0) < 0.0)
    if len(backward):
        row = int(backward[0])
        raise InputError(
            f"{path}: row {row + 2}: time_s", float(table[row, 0]), "a time of 0 or more, not before the last"
        )
    reports = []
    for at_s, rows in groupby(enumerate(table.tolist(), start=2), lambda numbered: numbered[1][0]):
        places = tuple(_check_place(path, row, values) for row, values in rows)
        if len(places) > FINGERS_MAX:
            raise InputError(f"{path}: time {at_s:g} s", len(places), f"at most {FINGERS_MAX} fingertips")
        reports.append(FingerReport(at_s, places))
    return [*reports, FingerReport(reports[-1].at_s + LIFTED_S, ())]


def _check_place(path: Path, row: int, values: list[float]) -> FingerPlace:
    """Return the fingertip of a row. Raise InputError if the display cannot have it."""
    _, number, *place = values
    members: dict[str, float] = dict(zip(COLUMNS[2:], place, strict=True))
    if number != int(number):
        raise InputError(f"{path}: row {row}: number", number, "a whole number")
    try:
        FingerMessage.model_validate({"number": int(number), **members})
    except ValidationError as error:
        raise build_input_error(error, f"{path}: row {row}") from None
    return FingerPlace(int(number), *place)
