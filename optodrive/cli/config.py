"""`optodrive config new | show | check`: write, show or check a configuration."""

import os
import sys
from collections.abc import Callable, Iterator
from json import dumps
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_answer, print_json
from optodrive.core.errors import MISSING, InputError

EXCHANGE_REMEDY = "state the uid of each stage's board, or its port's name below /dev/serial/by-id"
Answer = TypeVar("Answer", int, float, str)
COUNT_MAX = 200
"""Largest number of rows or columns of a new configuration."""
PITCH, POWER = "display.pitch_m", "laser.max_power_w"


GROUP = typer.Typer(help="Write, show or check a configuration.", no_args_is_help=True)


@GROUP.command()
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="Configuration to write; no file is overwritten.")],
    rows: Annotated[int | None, typer.Option("--rows", min=1, max=COUNT_MAX, help="Rows of pixels.")] = None,
    columns: Annotated[int | None, typer.Option("--columns", min=1, max=COUNT_MAX, help="Columns of pixels.")] = None,
    pitch_mm: Annotated[
        float | None,
        typer.Option("--pitch-mm", metavar="MM", help="Distance of neighbouring pixels."),
    ] = None,
    power_w: Annotated[
        float | None,
        typer.Option("--power-w", metavar="W", help="Power of the laser on the pixels at full duty."),
    ] = None,
    lens_mm: Annotated[
        float | None,
        typer.Option("--lens-mm", metavar="MM", help="Focal length of the f-theta lens."),
    ] = None,
    port: Annotated[
        str | None,
        typer.Option(
            "--port",
            metavar="DEVICE",
            help="Serial device of the board, simulated, helios, ether_dream:HOST or idn:HOST.",
        ),
    ] = None,
    kpps: Annotated[
        float | None,
        typer.Option("--kpps", metavar="N", min=1.0, max=100.0, help="Rating of the galvos at 8 degrees, in kpps."),
    ] = None,
) -> None:
    """Write a configuration. Ask on the terminal for each value that no option states."""
    from optodrive.core.files import check_output, write_text
    from optodrive.device.config_template import NewDisplay, check_lens, check_number, check_port, write_template
    from optodrive.planning.display_model import DisplayModel

    check_output("FILE", file, ".toml")
    rows = _ask("--rows", rows, "Rows of pixels", 4, _check_count)
    columns = _ask("--columns", columns, "Columns of pixels", 4, _check_count)
    question = "Distance of neighbouring pixels, mm"
    pitch_mm = _ask("--pitch-mm", pitch_mm, question, 4.0, lambda option, mm: check_number(option, mm, PITCH, "mm"))
    question = "Power of the laser on the pixels at full duty, W"
    power_w = _ask("--power-w", power_w, question, 2.45, lambda option, w: check_number(option, w, POWER, "W"))
    farthest_m = 0.5e-3 * (max(rows, columns) - 1) * pitch_mm
    question = "Focal length of the f-theta lens, mm"
    lens_mm = _ask("--lens-mm", lens_mm, question, 220.0, lambda option, mm: check_lens(option, mm, farthest_m))
    port = _ask("--port", port, "Serial device of the board, simulated, or a laser DAC", "simulated", check_port)
    display = NewDisplay(file.stem, rows, columns, 1e-3 * pitch_mm, power_w, 1e-3 * lens_mm, port, kpps)
    text, config = write_template(display, file)
    DisplayModel.from_config(config)
    write_text(file, text)
    print(f"written          {file}: check servo, caps and sizes in it against your own parts")
    print(f"next             optodrive serve --config {file}")


def _check_count(option: str, count: int) -> None:
    if not 1 <= count <= COUNT_MAX:
        raise InputError(option, count, f"1 to {COUNT_MAX}")


def _ask(
    option: str, value: Answer | None, question: str, default: Answer, check: Callable[[str, Answer], None]
) -> Answer:
    """Return the option's value, or the first answer on the terminal that passes the check. Raise InputError.

    check: raises InputError for a value that no display has. Without a terminal nobody can answer, which is refused.
    """
    if value is not None:
        check(option, value)
        return value
    if not sys.stdin.isatty():
        raise InputError(option, MISSING, f"{option}, because without a terminal nobody can answer: {question}")
    while True:
        text = typer.prompt(question, default=str(default), err=True)
        try:
            answer = _convert(option, text, default)
            check(option, answer)
        except InputError as error:  # one wrong answer does not cost the earlier ones
            print(f"optodrive: {error}", file=sys.stderr)
        else:
            return answer


def _convert(option: str, text: str, default: Answer) -> Answer:
    """Return an answer as a value of the default's type."""
    try:
        return type(default)(text)
    except ValueError:
        raise InputError(option, text, f"a number without its unit, such as {default}") from None


@GROUP.command()
def show(config: ConfigOption = None, json: JsonOption = False) -> None:
    """Show the effective configuration with every pixel and number."""
    from optodrive.device.config_file import load_config
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.effective_config import build_effective_config

    effective = build_effective_config(DisplayModel.from_config(load_config(config)))
    if json:
        print_json(effective)
        return
    document = effective.model_dump(mode="json")
    pixels = document["display"].pop("pixels")
    document["display"]["pixels"] = f"{len(pixels)}, listed with --json"
    print("\n".join(_list_section(document, "")))


def _list_section(table: dict[str, Any], name: str) -> Iterator[str]:
    """Yield the lines of a section, and then those of the sections within it, as in a configuration file."""
    if name:
        yield f"\n[{name}]"
    for key, value in table.items():
        if not isinstance(value, dict) or not value:
            yield f"{key} = {dumps(value, ensure_ascii=False)}"
    for key, value in table.items():
        if isinstance(value, dict) and value:
            yield from _list_section(value, f"{name}.{key}" if name else key)


@GROUP.command()
def check(
    file: Annotated[str | None, typer.Argument(metavar="[FILE]", help="The same as --config FILE.")] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Check a configuration file and the files that it names. Tokens are checked only for the daemon's user."""
    from optodrive.daemon.api.tokens import read_private_tokens
    from optodrive.device.config_file import load_config
    from optodrive.planning.display_model import DisplayModel

    if file is not None and config is not None:
        raise InputError("FILE", file, "FILE or --config, not both")
    display = DisplayModel.from_config(load_config(file or config))
    tokens = display.config.daemon.tokens
    if tokens and os.access(tokens, os.R_OK):
        read_private_tokens(Path(tokens))
    name, pixels = display.config.name, len(display.layout)
    exchangeable = display.config.find_exchangeable_boards()
    warnings = [] if exchangeable is None else [f"{exchangeable}; {EXCHANGE_REMEDY}"]
    lines = [f"{name}: {pixels} pixels, configuration valid", *(f"warning: {each}" for each in warnings)]
    print_answer({"name": name, "pixels": pixels, "ok": True, "warnings": warnings}, lines, json)
