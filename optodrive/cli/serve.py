"""`optodrive serve`: run the daemon."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import ConfigOption, FieldOption, MirrorsOption, ModelOption, PixelMapOption, load_run_config
from optodrive.cli.output import announce_compilation

if TYPE_CHECKING:
    from optodrive.device.config import Config


def serve(
    config: ConfigOption = None,
    model: ModelOption = None,
    field: FieldOption = None,
    mirrors: MirrorsOption = None,
    pixel_map: PixelMapOption = None,
    port: Annotated[
        int | None, typer.Option("--port", min=0, max=65535, help="TCP port instead of the configured one.")
    ] = None,
    capture: Annotated[
        Path | None,
        typer.Option("--capture", metavar="FILE", help="Write every byte on the link to the board to a new file."),
    ] = None,
    record_session: Annotated[
        Path | None,
        typer.Option("--record-session", metavar="FILE.h5", help="Record requests, plans and executed pulses."),
    ] = None,
) -> None:
    """Run the daemon: the processes that drive the board, plan, and serve the REST API and the live page."""
    from optodrive.core.files import check_output
    from optodrive.daemon.supervisor.daemon import run
    from optodrive.lab.recording.storage import HDF5_SUFFIXES

    check_output("--capture", capture)
    check_output("--record-session", record_session, *HDF5_SUFFIXES)

    def load() -> "Config":
        loaded = load_run_config(config, model, field, mirrors, pixel_map)
        if port is None:
            return loaded
        return loaded.model_copy(update={"daemon": loaded.daemon.model_copy(update={"port": port})})

    first = load()
    announce_compilation()
    with first.name_file():
        run(first, capture, load, record_session)
