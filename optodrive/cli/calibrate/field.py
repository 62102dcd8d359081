"""`optodrive calibrate field`: fit a calibrated field to a file of measured spots.

Its output, which `camera` and `board` share, is a field file, an HTML report, text and JSON.
"""

from dataclasses import dataclass
from dataclasses import field as dataclass_field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import list_written, print_answer

if TYPE_CHECKING:
    from optodrive.lab.calibration.field_fit import FieldFit


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
        listed = ", ".join(str(row + first_line) for row in outlier_rows[:OUTLIERS_LISTED_MAX])
        omitted = len(outlier_rows) - OUTLIERS_LISTED_MAX
        more = f" and {omitted} more" if omitted > 0 else ""
        lines.append(f"outliers         line{'s' if len(outlier_rows) > 1 else ''} {listed}{more}")
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
