"""`optodrive validate`."""

import typer

from optodrive.cli.options import JsonOption


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("validate")(validate)


def validate(json: JsonOption = False) -> None:
    """Hold the models against every fact of the paper they can speak to."""
    from optodrive.cli.validate import validate as print_table

    print_table(json)
