"""Options and output that commands share."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.device.config import Config

ConfigOption = Annotated[
    str | None, typer.Option("--config", metavar="FILE", help="Configuration file, or a shipped name.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else on stdout.")]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", metavar="model.toml", help="Plan with this parameter set, as `diagnose` writes it."),
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
UrlOption = Annotated[str, typer.Option("--url", help="Where the daemon listens; unix:PATH for its socket.")]
StrictOption = Annotated[bool, typer.Option("--strict", help="The same as --policy refuse.")]
PolicyOption = Annotated[
    Literal["trim", "delay", "refuse"],
    typer.Option("--policy", help="What becomes of a frame that a cap does not allow as it is."),
]
FitOption = Annotated[
    Literal["as_is", "even", "priority"],
    typer.Option(
        "--fit", help="What does not fit on the beam: even lowers all of it, priority leaves out the less important."
    ),
]
DEFAULT_URL = "http://127.0.0.1:8450"


def check_model_path(path: Path) -> Path:
    """The file itself; InputError for another kind, which would be taken for the name of a shipped set."""
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
    """The configuration, following a model and what was calibrated where given; InputError with one line."""
    from optodrive.device.config import apply_measured_servo, load_config
    from optodrive.device.pixel_map import replace_pixel_map

    # A file of mirrors lowers a cap: the one asked for here stands in place of the configuration's, not on top of it.
    loaded = (
        load_config(config)
        if mirrors is None
        else apply_measured_servo(load_config(config, measured_servo=False), mirrors)
    )
    if field is not None:
        scanner = loaded.scanner.model_copy(update={"field": str(field)})
        loaded = loaded.model_copy(update={"scanner": scanner})
    if pixel_map is not None:
        loaded = replace_pixel_map(loaded, pixel_map)
    if model is None:
        return loaded
    section = loaded.pixel_model.model_copy(update={"parameters": str(check_model_path(model))})
    return loaded.model_copy(update={"pixel_model": section})


def print_json(document: object) -> None:
    """Print one JSON object on stdout; it may be or contain Pydantic models."""
    json.dump(document, sys.stdout, indent=2, ensure_ascii=False, default=_convert_model)
    sys.stdout.write("\n")


def _convert_model(value: object) -> object:
    from pydantic_core import to_jsonable_python

    return to_jsonable_python(value)


def announce_compilation() -> None:
    """Say on stderr why the first run after an install or upgrade takes so long."""
    from optodrive.core.kernels import is_cold

    if is_cold():
        print("optodrive: compiling kernels, half a minute, once", file=sys.stderr)


@contextmanager
def show_progress(label: str) -> Iterator[Callable[[float], None]]:
    """A bar on stderr, where that is a terminal; give it the share done, 0 to 1."""
    if not sys.stderr.isatty():
        yield lambda share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn(label), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=1.0)
        yield lambda share: bar.update(task, completed=share)
