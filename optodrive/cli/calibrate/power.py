"""`optodrive calibrate power`: the laser's power over its duty, from the table of a power meter."""

from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import JsonOption
from optodrive.cli.output import list_written, print_answer


def power(
    table: Annotated[
        Path, typer.Argument(metavar="FILE.csv", help="Columns duty, 0 to 1, and power_W, at the sample.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="laser.toml", help="Write the part of a configuration.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Turn a power meter's table into the keys max_power_w, threshold_w and curve of a configuration's [laser]."""
    from optodrive.core.files import check_output, write_text
    from optodrive.core.laser_power import read_power_table

    check_output("--out", out, ".toml")
    measured = read_power_table(table)
    part = measured.to_toml(table.name)
    if out is not None:
        write_text(out, part)
    half = next(duty for duty, power_w in measured.curve if power_w >= 0.5 * measured.max_power_w)
    lines = [
        f"power            {measured.max_power_w:g} W at full duty, half of it by duty {half:g}",
        f"threshold        {f'{measured.threshold_w:g} W' if measured.threshold_w else 'none'}",
        *(list_written(out) if out else ["", *part.splitlines(), ""]),
        "next             put these keys in place of those of [laser], and build the board's firmware anew",
    ]
    print_answer(measured._asdict(), lines, json)
