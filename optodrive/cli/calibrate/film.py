"""`optodrive calibrate film`: find where a multitouch film lies on the display, from touches at known pixels."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.fingers import RecordOption, open_film
from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import list_written, print_answer
from optodrive.core.errors import InputError, Unquoted

if TYPE_CHECKING:
    from optodrive.core.types.arrays import FloatArray
    from optodrive.device.config import PixelLayout


def film(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="/dev/input/event…, or a recording of the touches.")],
    out: Annotated[Path, typer.Option("--out", metavar="film.toml", help="Write the calibration.")],
    pixels: Annotated[
        str | None,
        typer.Option("--pixels", metavar="N,N,…", help="Pixels to touch, in order. Default: at the corners."),
    ] = None,
    record: RecordOption = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Find where a multitouch film lies on the display, from touches at known pixels one after the other."""
    import numpy as np

    from optodrive.cli.signals import end_as_interrupted
    from optodrive.core.files import check_output
    from optodrive.device.config import build_pixel_layout
    from optodrive.device.config_file import load_config
    from optodrive.tracking.film import choose_corner_pixels, iterate_touches
    from optodrive.tracking.film_calibration import fit_film, write_film_calibration

    check_output("--out", out, ".toml", may_exist=True)
    layout = build_pixel_layout(load_config(config).display)
    chosen = choose_corner_pixels(layout) if pixels is None else _parse_pixels(pixels, layout)
    points: list[FloatArray] = []
    with end_as_interrupted(), open_film(path, record) as (axes, contacts):
        touches = iterate_touches(contacts)
        for pixel in chosen:
            place = f"pixel {pixel}, row {layout.row[pixel]}, column {layout.column[pixel]}"
            print(f"touch {place}, with one finger, and lift it", file=sys.stderr, flush=True)
            touch = next(touches, None)
            if touch is None:
                raise InputError(str(path), Unquoted(f"{len(points)} touches"), f"{len(chosen)}, one at each pixel")
            points.append(touch)
    places_m = np.column_stack([layout.x_m, layout.y_m])[list(chosen)]
    calibration = fit_film(axes, np.array(points), places_m)
    write_film_calibration(out, calibration)
    answer = {"touches": len(points), "residual_m": calibration.residual_m, "pixels": list(chosen)}
    rest = f"{1e3 * calibration.residual_m:.2g} mm from their pixels (rms)" if len(points) > 3 else "no residual: three"
    print_answer(answer, [f"touches          {len(points)}, {rest}", *list_written(out)], json)


def _parse_pixels(text: str, layout: "PixelLayout") -> tuple[int, ...]:
    """Return pixels from a list. Raise InputError for one that the display does not have, or has twice."""
    parts = text.split(",")
    if not all(part.strip().isdecimal() and int(part) < len(layout) for part in parts):
        raise InputError("--pixels", text, f"pixels from 0 to {len(layout) - 1}, separated by commas")
    chosen = tuple(map(int, parts))
    if len(set(chosen)) < len(chosen):
        raise InputError("--pixels", text, "each pixel once")
    return chosen
