"""`optodrive calibrate field | camera`: fit a calibrated field to measured spots, from a file or from pictures.

Its output, which `board` shares, is a field file, an HTML report, text and JSON. The pictures are of a grid and of the
beam.
"""

from dataclasses import dataclass
from dataclasses import field as dataclass_field
from html import escape
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import list_written, print_answer
from optodrive.core.errors import InputError
from optodrive.core.quantity import list_names, m_to_um

if TYPE_CHECKING:
    from optodrive.lab.calibration.field_fit import FieldFit
if TYPE_CHECKING:
    from optodrive.lab.calibration.picture_spots import CameraMeasurement


FieldOutOption = Annotated[Path | None, typer.Option("--out", metavar="field.toml", help="Write the calibrated field.")]
ReportOption = Annotated[
    Path | None, typer.Option("--report", metavar="report.html", help="Write an HTML report of the fit.")
]
OUTLIERS_LISTED_MAX = 12


@dataclass(frozen=True)
class FieldCalibration:
    """A fitted field, the file of its spots, and the statistics and report lines of the measurement, if any."""

    fit: "FieldFit"
    spots_file: Path
    stats: dict[str, object] = dataclass_field(default_factory=dict)
    report_lines: tuple[str, ...] = ()


def check_calibration_outputs(out: Path | None, report: Path | None) -> None:
    """Raise InputError unless the field and the report can be written. Call it before the measurement."""
    from optodrive.core.files import check_output

    check_output("--out", out, ".toml")
    check_output("--report", report, ".html")


def write_calibration(calibration: FieldCalibration, out: Path | None, report: Path | None, json: bool) -> None:
    """Write the field and the report where requested, and print the fit's statistics."""
    from optodrive.lab.calibration.field_output import summarize_fit, write_field
    from optodrive.lab.calibration.spots import find_first_line

    source = str(calibration.spots_file)
    stats = summarize_fit(calibration.fit) | calibration.stats
    lines = [*format_fit(stats, find_first_line(calibration.spots_file)), *calibration.report_lines]
    written = {name: path for name, path in (("field", out), ("report", report)) if path is not None}
    if out is not None:
        write_field(out, calibration.fit, source)
    if report is not None:
        _write_report(report, calibration.fit, source, lines)
    lines += [line for path in written.values() for line in list_written(path)]
    print_answer(stats | {name: str(path) for name, path in written.items()}, lines, json)


def format_fit(stats: dict[str, Any], first_line: int) -> list[str]:
    """Format the statistics of a fit as text lines.

    first_line: number of the line of the first spot in its file
    """
    outlier_rows = stats["outlier_rows"]
    lines = [f"spots            {stats['spots']}, {len(outlier_rows)} of them outliers"]
    if outlier_rows:
        listed = list_names([row + first_line for row in outlier_rows], OUTLIERS_LISTED_MAX)
        lines.append(f"outliers         line{'s' if len(outlier_rows) > 1 else ''} {listed}")
    lines += [
        f"residual         {stats['residual_rms_um']:.1f} µm rms, {stats['residual_max_um']:.1f} µm max",
        f"noise            {stats['noise_um']:.1f} µm per axis; "
        f"not explained by mirrors, lens and board {stats['surface_um']:.1f} µm",
        f"sigma            {stats['sigma_rms_um']:.1f} µm per axis, {stats['sigma_max_um']:.1f} µm max; "
        "by region, as seen from the front:",
    ]
    return lines + ["                 " + "".join(f"{value:8.1f}" for value in row) for row in stats["sigma_um"]]


def _write_report(path: Path, fit: "FieldFit", source: str, lines: list[str]) -> None:
    from optodrive.core.document import Document, Figure, Markup, Section, Table
    from optodrive.core.files import write_text
    from optodrive.lab.calibration.field_output import draw_residuals, draw_sigma_map

    sigmas = fit.prior.sigma * fit.covariance.diagonal()[: len(fit.prior.sigma)] ** 0.5
    rows = [
        (name, f"{value:.6g}", f"{sigma:.2g}")
        for (name, value), sigma in zip(fit.field.geometry._asdict().items(), sigmas, strict=True)
    ]
    drawings = [
        Figure(draw_residuals(fit), "Residual (measured minus fitted) by commanded position"),
        Figure(draw_sigma_map(fit), "Sigma of the beam position per axis"),
    ]
    table = Table("Parameters", ("parameter", "value", "sigma"), rows, {1, 2})
    hint = "Parameters are correlated: the field is better determined than its parameters."
    fitted = Section("Fit", [Markup(f"<pre>{escape(chr(10).join(lines))}</pre>"), drawings])
    body = [fitted, Section("Parameters", [hint, table])]
    write_text(path, Document(f"Calibration from {source}", "field", ["Calibrated field"], body).to_html())


def field(
    spots: Annotated[Path, typer.Argument(metavar="SPOTS.csv", help="Measured spots: x_code,y_code,x_m,y_m.")],
    out: FieldOutOption = None,
    report: ReportOption = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Fit the field to a file of measured spots."""
    from optodrive.device.config_file import load_config
    from optodrive.lab.calibration.field_fit import fit_field
    from optodrive.lab.calibration.spot_checks import check_fit, check_spots
    from optodrive.lab.calibration.spots import FieldPrior, read_spots

    check_calibration_outputs(out, report)
    prior = FieldPrior.from_config(load_config(config))
    measured = read_spots(spots, prior.display)
    check_spots(str(spots), measured, prior)
    fit = fit_field(measured, prior)
    check_fit(str(spots), fit)
    write_calibration(FieldCalibration(fit, spots), out, report, json)


NAMES_LISTED_MAX = 6


def camera(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Pictures of a grid and of the spots, described by pictures.toml.")
    ],
    out: FieldOutOption = None,
    report: ReportOption = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Measure spots in pictures from a camera, and fit the field to them."""
    check_calibration_outputs(out, report)
    write_calibration(calibrate_by_camera(folder, config), out, report, json)


def calibrate_by_camera(folder: Path, config: str | None) -> FieldCalibration:
    """Measure the spots, write them to FOLDER/spots.csv (input of `calibrate field`), and fit a field.

    Raises InputError for a folder, a picture or spots that cannot be used.
    """
    from optodrive.device.config_file import load_config
    from optodrive.lab.calibration.field_fit import fit_field
    from optodrive.lab.calibration.picture_spots import measure_folder
    from optodrive.lab.calibration.pictures import SPOTS_FILE
    from optodrive.lab.calibration.spot_checks import check_fit, check_spots
    from optodrive.lab.calibration.spots import FieldPrior, write_spots

    if not folder.is_dir():
        raise InputError("FOLDER", str(folder), "a folder with pictures.toml")
    prior = FieldPrior.from_config(load_config(config))
    measured, path = measure_folder(folder), folder / SPOTS_FILE
    replaced = path.exists()
    write_spots(path, measured.spots, prior.display)
    check_spots(str(path), measured.spots, prior)
    fit = fit_field(measured.spots, prior)
    check_fit(str(path), fit)
    masks = {"outlier": fit.outlier, "saturated": measured.is_saturated, "outside": measured.is_outside}
    pictures = {
        key: [name for name, is_selected in zip(measured.names, mask, strict=True) if is_selected]
        for key, mask in masks.items()
    }
    stats = {"spots_file": str(path), **{f"{key}_pictures": names for key, names in pictures.items()}}
    lines = format_camera_stats(measured, pictures, f"spots {'replaced' if replaced else 'written '}   {path}")
    return FieldCalibration(fit, path, stats | build_camera_stats(measured), lines)


def build_camera_stats(measured: "CameraMeasurement") -> dict[str, object]:
    """Build the statistics that the camera adds to those of the fit, for --json."""
    return {
        "grid_pictures": measured.view_count,
        "pixel_um": round(m_to_um(measured.pixel_scale_m), 3),
        "corners_rms_px": round(measured.plane.residual_px, 4),
        "spot_sigma_um": [round(m_to_um(sigma_m), 3) for sigma_m in measured.sigma_m.tolist()],
    }


def format_camera_stats(measured: "CameraMeasurement", pictures: dict[str, list[str]], written: str) -> tuple[str, ...]:
    """Format the statistics of the camera as text lines.

    pictures: names of those that are suspect, by kind; written: last line
    """
    sigma_um = sorted(m_to_um(sigma_m) for sigma_m in measured.sigma_m.tolist())
    lines = [
        f"camera           {m_to_um(measured.pixel_scale_m):.0f} µm per pixel; grid corners "
        f"{measured.plane.residual_px:.2f} px rms per axis, "
        f"from {measured.view_count} picture{'s' if measured.view_count > 1 else ''}",
        f"centroids        sigma {median(sigma_um):.1f} µm per axis, {sigma_um[-1]:.1f} µm max",
    ]
    outside = " outside the grid: the camera model is extrapolated there"
    for key, label, end in (
        ("outlier", "outlier pictures", ""),
        ("saturated", "saturated       ", ""),
        ("outside", "warning         ", outside),
    ):
        if pictures[key]:
            lines.append(f"{label} {list_names(pictures[key], NAMES_LISTED_MAX)}{end}")
    return (*lines, written)
