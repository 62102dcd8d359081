"""`optodrive validate`."""

from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import JsonOption, check_model_path
from optodrive.core.errors import InputError


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("validate")(validate)


def validate(
    json: JsonOption = False,
    diagnose: Annotated[
        bool,
        typer.Option(
            "--diagnose", help="Name what Text S1 gets wrong in the paper's numbers, and what mending it gains."
        ),
    ] = False,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="model.toml", help="Hold this parameter set beside the others.")
    ] = None,
) -> None:
    """Hold the models against every fact of the paper they can speak to."""
    if diagnose and model is not None:
        raise InputError("--model", str(model), "--diagnose or --model, not both: --diagnose begins from Text S1")
    if diagnose:
        from optodrive.cli.validate_diagnose import diagnose_paper_facts as tell

        tell(json)
        return
    from optodrive.cli.validation_table import print_validation as print_table

    print_table(json, None if model is None else check_model_path(model))
