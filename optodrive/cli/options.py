"""Options and output that commands share."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
OMITTED_LISTED_MAX = 5
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


def print_json(document: dict[str, Any]) -> None:
    """One JSON object on stdout."""
    json.dump(document, sys.stdout, indent=2, ensure_ascii=False)
    sys.stdout.write("\n")


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


def format_plan_summary(summary: dict[str, Any]) -> list[str]:
    """A plan's summary as a few lines of plain words."""
    lines = [
        *_format_feasibility(summary["feasibility"]),
        f"pulses           {summary['pulses']}",
        f"duration         {summary['duration_s']:.4f} s",
        f"beam on          {summary['beam_on_s']:.4f} s, {100 * summary['beam_on_share']:.1f} % of it",
        f"moves            {summary['moves_s']:.4f} s"
        + (f", and {summary['galvo_pause_s']:.1f} s of galvo pauses" if summary["galvo_pause_s"] else ""),
        f"energy           {summary['energy_j']:.4f} J incident",
        f"tallest          {summary['predicted_max_um']:.1f} µm predicted"
        + (f", {summary['tallest_asked_um']:.1f} µm asked for" if summary["tallest_asked_um"] else "")
        + (f", at pixel {summary['tallest_pixel']}" if summary["tallest_pixel"] is not None else ""),
        f"least headroom   {summary['headroom_min_k']:.1f} K below the absorber cap",
    ]
    trimmed = summary["trimmed"]
    if trimmed["pulses"]:
        reasons = ", ".join(f"{count} by {reason}" for reason, count in trimmed["by_reason"].items())
        lines.append(f"trimmed          {trimmed['pulses']} pulses, {trimmed['energy_j'] * 1e3:.2f} mJ: {reasons}")
        lines.append(f"                 {_format_shortfall(summary['shortfall'])}")
    else:
        lines.append("trimmed          nothing")
    if summary["delays"]:
        lines.append(f"waited           {_format_delays(summary['delays'])}")
    lines += [f"late             {sentence}" for sentence in summary["late"][:5]]
    if len(summary["late"]) > 5:
        lines.append(f"late             and {len(summary['late']) - 5} more frames")
    if summary["train_late_s"] > 0:
        lines.append(
            f"trains           the mirrors' moves delay pulses by up to {summary['train_late_s'] * 1e3:.2f} ms"
        )
    if summary["dead"]["message"]:
        lines.append(f"dead             {summary['dead']['message']}")
    if summary["skipped"]:
        lines.append(f"no pulse needed  {len(summary['skipped'])} times: the heat left in the pixel reaches the target")
    return lines


def _format_feasibility(feasibility: dict[str, Any]) -> list[str]:
    if feasibility["fits"]:
        return ["fits: yes" if feasibility["proof"] == "planned" else f"fits: yes, {feasibility['message']}"]
    lines = [f"fits: no, {feasibility['message']}"]
    if feasibility["fit"] == "even":
        lines.append(f"shown            all heights and powers × {feasibility['height_factor']:g}")
    for omitted in feasibility["omitted"][:OMITTED_LISTED_MAX]:
        lines.append(f"left out         {omitted['name']}: {_format_pixels(omitted['pixels'])}")
    more = len(feasibility["omitted"]) - OMITTED_LISTED_MAX
    if more > 0:
        lines.append(f"left out         and less of {more} more")
    return lines


def _format_pixels(pixels: list[int]) -> str:
    listed = ", ".join(map(str, pixels[:20]))
    return (
        f"pixel{'s' if len(pixels) > 1 else ''} {listed}{f' and {len(pixels) - 20} more' if len(pixels) > 20 else ''}"
    )


def _format_shortfall(shortfall: dict[str, Any]) -> str:
    later_s = shortfall["fits_later_s"]
    fits = "at no later time" if later_s is None else f"{later_s:.3f} s later"
    return f"first pixel {shortfall['pixel']}, {shortfall['margin_j'] * 1e3:.2f} mJ too much; all of it fits {fits}"


def _format_delays(delays: list[dict[str, Any]]) -> str:
    first, total_s = delays[0], sum(delay["wait_s"] for delay in delays)
    where = f"{first['source']}, {first['wait_s']:.3f} s for pixel {first['pixel']} ({first['cap']})"
    return f"{total_s:.3f} s in {len(delays)} frames or trains, first in {where}"
