"""Files of a discovery: a Python file that defines `model`, and records as CSV."""

import runpy
from pathlib import Path

from optodrive.core.errors import InputError
from optodrive.core.numeric_tables import open_table
from optodrive.lab.discovery.model import OdeModel, Record

TIME = "t_s"


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
    inputs = len(model.inputs)
    with open_table(path, (TIME, *model.inputs, *model.outputs)) as columns:
        table = columns.read_numbers(missing=model.outputs)
    try:
        return Record(table[:, 0], table[:, 1 : 1 + inputs], table[:, 1 + inputs :], name=path.stem)
    except InputError as error:
        raise InputError(f"{path}: {error.where}", error.value, error.expected) from None
