"""`optodrive serve`: the daemon."""

from typing import Annotated

import typer

from optodrive.cli.options import ConfigOption, ModelOption, announce_compilation, configured


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(serve)


def serve(
    config: ConfigOption = None,
    model: ModelOption = None,
    port: Annotated[
        int | None, typer.Option("--port", min=0, max=65535, help="TCP port, instead of the configured.")
    ] = None,
) -> None:
    """Run the daemon: the engine that drives the board, and REST."""
    from optodrive.daemon.server import run

    loaded = configured(config, model)
    if port is not None:
        loaded = loaded.model_copy(update={"daemon": loaded.daemon.model_copy(update={"port": port})})
    announce_compilation()
    run(loaded)
