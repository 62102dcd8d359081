"""`optodrive validate`: compare the models with the facts of the paper."""

from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import JsonOption, check_model_path
from optodrive.core.errors import InputError


def validate(
    json: JsonOption = False,
    diagnose: Annotated[
        bool,
        typer.Option(
            "--diagnose",
            help="Name the errors of Text S1 in the paper's measurements, and the gain from correcting them.",
        ),
    ] = False,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="model.toml", help="Compare this parameter set too.")
    ] = None,
) -> None:
    """Compare the models with every fact of the paper that they predict."""
    if diagnose and model is not None:
        raise InputError("--model", str(model), "--diagnose or --model, not both: --diagnose starts from Text S1")
    if diagnose:
        from optodrive.cli.validate_diagnose import diagnose_paper_facts as tell

        tell(json)
        return
    from optodrive.cli.validation_table import print_validation as print_table

    print_table(json, None if model is None else check_model_path(model))
