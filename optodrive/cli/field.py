"""`optodrive field`: display metres to DAC codes by a calibrated field, and back; grids of corrections."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import ConfigOption, JsonOption, print_json
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.core.types.arrays import FloatArray
    from optodrive.device.calibrated_field import Field

METRES, CODES = ("x_m", "y_m"), ("x_code", "y_code")
METRE_FORMAT, CODE_FORMAT = "%.10f", "%.4f"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("field")(field)


def field(
    calibration: Annotated[
        Path | None, typer.Option("--calibration", metavar="field.toml", help="The field, as `calibrate` writes it.")
    ] = None,
    points: Annotated[
        Path | None, typer.Option("--points", metavar="points.csv", help="x_m,y_m; with --inverse x_code,y_code.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="codes.csv", help="Where to write; of --import the field.toml.")
    ] = None,
    inverse: Annotated[bool, typer.Option("--inverse", help="Codes to metres.")] = False,
    export: Annotated[
        Path | None, typer.Option("--export", metavar="grid.cor", help="Write the field as a grid, LMC1COR_1.0.")
    ] = None,
    imported: Annotated[
        Path | None, typer.Option("--import", metavar="grid.cor", help="Make a field.toml from a grid, LMC1COR_1.0.")
    ] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Convert display metres to DAC codes and back, or a field to a grid of corrections and back."""
    if imported is not None:
        done = _import(imported, _given("--out", out), config)
    else:
        from optodrive.device.field_file import read_field

        made = read_field(_given("--calibration", calibration))
        if export is not None:
            done = _export(made, export)
        else:
            done = _convert(made, _given("--points", points), _given("--out", out), inverse)
    if json:
        print_json(done)
    else:
        print(f"written          {done['out']}" + (f", {done['points']} points" if "points" in done else ""))
        if done.get("outside"):
            print(
                f"outside          {done['outside']} points lie where nothing was calibrated: nothing is claimed there"
            )


def _given(option: str, path: Path | None) -> Path:
    if path is None:
        raise InputError(option, None, "a file")
    return path


def _convert(made: "Field", points: Path, out: Path, inverse: bool) -> dict[str, Any]:
    import numpy as np

    from optodrive.core.numeric_tables import read_columns, write_columns

    table = read_columns(points, CODES if inverse else METRES)
    if inverse:
        _check_codes(points, table)
        codes, found = table, np.column_stack(made.position_m(table[:, 0], table[:, 1]))
        write_columns(out, METRES, found, (METRE_FORMAT,) * 2)
    else:
        codes = found = np.column_stack(made.codes(table[:, 0], table[:, 1]))
        lost = np.flatnonzero(np.isnan(found[:, 0]))
        if len(lost):
            row = int(lost[0])
            raise InputError(
                f"{points}: row {row + 2}", f"{table[row, 0]:g}, {table[row, 1]:g} m", "a place that a code leads to"
            )
        write_columns(out, CODES, found, (CODE_FORMAT,) * 2)
    sigma_m = made.sigma_m(codes[:, 0], codes[:, 1])
    inside = np.isfinite(sigma_m)
    return {
        "out": str(out),
        "points": len(table),
        "outside": int(np.count_nonzero(~inside)),
        "sigma_max_um": 1e6 * float(sigma_m[inside].max()) if inside.any() else None,
    }


def _check_codes(points: Path, table: "FloatArray") -> None:
    import numpy as np

    from optodrive.device.field_geometry import CODE_MAX

    bad = np.argwhere((table < 0) | (table > CODE_MAX))
    if len(bad):
        row, column = bad[0].tolist()
        raise InputError(f"{points}: row {row + 2}: {CODES[column]}", float(table[row, column]), f"0 to {CODE_MAX}")


def _export(made: "Field", export: Path) -> dict[str, Any]:
    from optodrive.lab.calibration.correction_grid import write_grid

    write_grid(export, made)
    return {"out": str(export)}


def _import(grid: Path, out: Path, config: str | None) -> dict[str, Any]:
    from optodrive.core.files import written_whole
    from optodrive.device.config import load_config
    from optodrive.device.field_file import field_toml, plain
    from optodrive.lab.calibration.correction_grid import field_of_grid
    from optodrive.lab.calibration.field_prior import Prior

    made = field_of_grid(grid, Prior.of(load_config(config)))
    about: dict[str, str | float | int] = {"source": plain(f"{grid}, a grid: how sure it is it does not say")}
    with written_whole(out) as temporary:
        temporary.write_text(field_toml(made, about), encoding="utf-8")
    return {"out": str(out), "sigma_max_um": 1e6 * float(made.sigma_grid_m.max())}
