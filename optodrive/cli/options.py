"""Options that commands share, and the configuration that they select."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.core.daemon_url import URL_ENVIRONMENT_VARIABLE
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.device.config import Config

ConfigOption = Annotated[
    str | None, typer.Option("--config", metavar="FILE", help="Configuration file, or a shipped name.")
]
StageOption = Annotated[
    str | None, typer.Option("--stage", metavar="NAME", help="The stage to drive, of several over one display.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else on stdout.")]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", metavar="model.toml", help="Plan with this parameter set, an output of `diagnose`."),
]
FieldOption = Annotated[
    Path | None,
    typer.Option("--field", metavar="field.toml", help="Aim by this calibrated field, an output of `calibrate`."),
]
MirrorsOption = Annotated[
    Path | None,
    typer.Option("--mirrors", metavar="mirrors.toml", help="Use these mirror servos, an output of `calibrate servo`."),
]
PixelMapOption = Annotated[
    Path | None,
    typer.Option(
        "--pixel-map", metavar="pixels.toml", help="Plan with this pixel map, an output of `calibrate pixels`."
    ),
]
UrlOption = Annotated[
    str, typer.Option("--url", envvar=URL_ENVIRONMENT_VARIABLE, help="URL of the daemon, or unix:PATH for its socket.")
]
HoldOption = Annotated[
    bool,
    typer.Option("--hold", help="Arm the board for the time of this command: it disarms with the end of its process."),
]


def check_model_path(path: Path) -> Path:
    """Return the path. Raise InputError without suffix .toml, which would name a shipped parameter set."""
    if path.suffix != ".toml":
        raise InputError("--model", str(path), "a .toml file")
    return path


def load_run_config(
    config: str | None,
    model: Path | None,
    field: Path | None = None,
    mirrors: Path | None = None,
    pixel_map: Path | None = None,
) -> "Config":
    """Load the configuration, and apply the parameter set and the calibration files that are given.

    Raises InputError for a file that cannot be used.
    """
    from optodrive.device.config_file import apply_measured_servo, load_config
    from optodrive.device.pixel_map import replace_pixel_map

    # mirrors.toml lowers a cap: the given file replaces that of the configuration instead of lowering the cap twice.
    loaded = load_config(config, measured_servo=mirrors is None)
    if len(loaded.stages) > 1 and (field or mirrors):
        option, path = ("--field", field) if field else ("--mirrors", mirrors)
        raise InputError(option, str(path), "one stage; of several, each states its files in its [stages.scanner]")
    if mirrors is not None:
        loaded = apply_measured_servo(loaded, mirrors)
    if field is not None:
        scanner = loaded.scanner.model_copy(update={"field": str(field)})
        loaded = loaded.model_copy(update={"scanner": scanner})
    if pixel_map is not None:
        loaded = replace_pixel_map(loaded, pixel_map)
    if model is None:
        return loaded
    section = loaded.pixel_model.model_copy(update={"parameters": str(check_model_path(model))})
    return loaded.model_copy(update={"pixel_model": section})
