"""Files of a discovery: a Python file that defines `model`, and records as CSV."""

import csv
import runpy
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.lab.discovery.model import OdeModel, Record

TIME = "t_s"
MISSING = ("", "nan", "NaN", "NAN")


def load_model(path: Path) -> OdeModel:
    """Return `model` of a Python file, which is executed."""
    if not path.is_file():
        raise InputError(str(path), "no such file", "a Python file that defines model = OdeModel(...)")
    try:
        content = runpy.run_path(str(path))
    except InputError:
        raise
    except Exception as error:
        raise InputError(str(path), f"{type(error).__name__}: {error}", "a Python file that runs") from error
    model = content.get("model")
    if not isinstance(model, OdeModel):
        raise InputError(f"{path}: model", type(model).__name__, "an OdeModel of optodrive.lab.discovery")
    return model


def read_record(path: Path, model: OdeModel) -> Record:
    """Return the record of a CSV file whose header names t_s and the inputs and outputs of the model, in any order.

    Further columns are ignored; an empty cell of an output was not measured.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    except csv.Error as error:
        raise InputError(str(path), str(error), "a CSV file") from None
    except UnicodeDecodeError:
        raise InputError(str(path), "not text", "a CSV file, UTF-8") from None
    header = [name.strip() for name in rows[0]] if rows else []
    names = (TIME, *model.inputs, *model.outputs)
    missing = next((name for name in names if name not in header), None)
    if missing is not None:
        raise InputError(f"{path}: first line", ",".join(header), f"a column {missing}")
    columns = [header.index(name) for name in names]
    table = np.full((len(rows) - 1, len(names)), np.nan)
    for number, row in enumerate(rows[1:]):
        for position, (name, column) in enumerate(zip(names, columns, strict=True)):
            cell = row[column].strip() if column < len(row) else ""
            if cell in MISSING and name in model.outputs:
                continue
            try:
                table[number, position] = float(cell)
            except ValueError:
                raise InputError(f"{path}: row {number + 2}: {name}", cell, "a number") from None
    inputs = len(model.inputs)
    try:
        return Record(table[:, 0], table[:, 1 : 1 + inputs], table[:, 1 + inputs :])
    except InputError as error:
        raise InputError(f"{path}: {error.where}", error.value, error.expected) from None
