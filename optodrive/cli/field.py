"""`optodrive field`: convert display positions to DAC codes and back, and fields to correction grids and back."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_answer
from optodrive.core.errors import MISSING, InputError

if TYPE_CHECKING:
    from optodrive.core.types.arrays import FloatArray
    from optodrive.device.calibrated_field import CalibratedField

POSITION_COLUMNS, CODE_COLUMNS = ("x_m", "y_m"), ("x_code", "y_code")
POSITION_FORMAT, CODE_FORMAT = "%.10f", "%.4f"


def field(
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="field.toml", help="Calibrated field, an output of `calibrate`."),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="points.csv", help="Input: x_m,y_m; with --inverse x_code,y_code."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="codes.csv", help="Output; with --import the field.toml.")
    ] = None,
    inverse: Annotated[bool, typer.Option("--inverse", help="Convert codes to metres.")] = False,
    export_path: Annotated[
        Path | None,
        typer.Option("--export", metavar="grid.cor", help="Write the field as a correction grid, LMC1COR_1.0."),
    ] = None,
    import_path: Annotated[
        Path | None,
        typer.Option("--import", metavar="grid.cor", help="Convert a correction grid, LMC1COR_1.0, to field.toml."),
    ] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Convert display metres to DAC codes and back, or a field to a correction grid and back."""
    from optodrive.core.files import check_output

    check_output("--export", export_path)
    check_output("--out", out, ".csv" if import_path is None else ".toml")
    if import_path is not None:
        result = _import(import_path, _require_option("--out", out), config)
    else:
        from optodrive.device.calibrated_field import load_field

        calibrated_field = load_field(_require_option("--calibration", calibration))
        if export_path is not None:
            result = _export(calibrated_field, export_path)
        else:
            result = _convert(
                calibrated_field, _require_option("--points", points), _require_option("--out", out), inverse
            )
    lines = [f"written          {result['out']}" + (f", {result['points']} points" if "points" in result else "")]
    if result.get("outside"):
        lines.append(
            f"outside          {result['outside']} points lie outside the calibrated region, where sigma is unknown"
        )
    print_answer(result, lines, json)


def _require_option(option: str, path: Path | None) -> Path:
    if path is None:
        raise InputError(option, MISSING, "a file")
    return path


def _convert(calibrated_field: "CalibratedField", points: Path, out: Path, inverse: bool) -> dict[str, Any]:
    import numpy as np

    from optodrive.core.numeric_tables import read_columns, write_columns

    table = read_columns(points, CODE_COLUMNS if inverse else POSITION_COLUMNS)
    if inverse:
        _check_codes(points, table)
        codes, converted = table, np.column_stack(calibrated_field.position_m(table[:, 0], table[:, 1]))
        write_columns(out, POSITION_COLUMNS, converted, (POSITION_FORMAT,) * 2)
    else:
        codes = converted = np.column_stack(calibrated_field.codes(table[:, 0], table[:, 1]))
        unreachable = np.flatnonzero(np.isnan(converted[:, 0]))
        if len(unreachable):
            row = int(unreachable[0])
            raise InputError(
                f"{points}: row {row + 2}", f"{table[row, 0]:g}, {table[row, 1]:g} m", "a position that a code reaches"
            )
        write_columns(out, CODE_COLUMNS, converted, (CODE_FORMAT,) * 2)
    sigma_m = calibrated_field.sigma_m(codes[:, 0], codes[:, 1])
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

    out_of_range = np.argwhere((table < 0) | (table > CODE_MAX))
    if len(out_of_range):
        row, column = out_of_range[0].tolist()
        raise InputError(
            f"{points}: row {row + 2}: {CODE_COLUMNS[column]}", float(table[row, column]), f"0 to {CODE_MAX}"
        )


def _export(calibrated_field: "CalibratedField", export: Path) -> dict[str, Any]:
    from optodrive.lab.calibration.field_output import write_correction_grid

    write_correction_grid(export, calibrated_field)
    return {"out": str(export)}


def _import(grid: Path, out: Path, config: str | None) -> dict[str, Any]:
    from optodrive.core.files import write_text
    from optodrive.device.calibrated_field import format_field, strip_toml_specials
    from optodrive.device.config_file import load_config
    from optodrive.lab.calibration.field_output import fit_correction_grid
    from optodrive.lab.calibration.spots import FieldPrior

    calibrated_field = fit_correction_grid(grid, FieldPrior.from_config(load_config(config)))
    metadata: dict[str, str | float | int] = {
        "source": strip_toml_specials(f"{grid}, a correction grid without uncertainties")
    }
    write_text(out, format_field(calibrated_field, metadata))
    return {"out": str(out), "sigma_max_um": 1e6 * float(calibrated_field.sigma_grid_m.max())}
