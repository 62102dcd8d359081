"""`optodrive calibrate`: measured spots to a calibrated field, and what is to be said of it."""

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.calibrate.board import (
    DEFAULT_FIELD_FILE,
    BoardCalibrationRequest,
    ManualOption,
    ReadingsOption,
    SpotPowerOption,
    SpotsMaxOption,
    TargetErrorOption,
    calibrate_on_board,
    delete_session,
)
from optodrive.cli.calibrate.camera import PicturesOption, calibrate_by_camera
from optodrive.cli.calibrate.pixels import MorePixelsArgument, PixelsOption, SweepOption, calibrate_pixels, write_sweep
from optodrive.cli.calibrate.servo import calibrate_servo
from optodrive.cli.options import ConfigOption, JsonOption, ModelOption, print_json
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.lab.calibration.field_fit import FieldFit

LISTED_MAX = 12
FIRST_DATA_LINE = 2
"""Row 0 of the spots stands on this line of their file."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("calibrate")(calibrate)


def calibrate(
    spots: Annotated[
        Path | None, typer.Option("--spots", metavar="spots.csv", help="Measured: x_code,y_code,x_m,y_m.")
    ] = None,
    mirrors: Annotated[
        Path | None,
        typer.Option("--mirrors", metavar="recording.h5", help="Measured: steps of both mirrors; finds their servos."),
    ] = None,
    pictures: PicturesOption = None,
    pixels: PixelsOption = None,
    more_pixels: MorePixelsArgument = None,
    pixels_sweep: SweepOption = None,
    model: ModelOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="field.toml", help="Write the field, or what else was calibrated.")
    ] = None,
    report: Annotated[Path | None, typer.Option("--report", metavar="report.html", help="Write a report.")] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
    manual: ManualOption = False,
    target_rms_um: TargetErrorOption = 10.0,
    spots_max: SpotsMaxOption = 25,
    readings: ReadingsOption = 3,
    spot_power_mw: SpotPowerOption = 5.0,
) -> None:
    """Fit a field to measured spots, to pictures of them, or measure on the board first.

    Or find the mirrors' servos, or each pixel's gain and offset.
    """
    from optodrive.device.config import load_config
    from optodrive.lab.calibration.field_fit import fit_field
    from optodrive.lab.calibration.field_prior import FieldPrior
    from optodrive.lab.calibration.spot_checks import check_fit, check_spots
    from optodrive.lab.calibration.spots import read_spots

    recordings = [*(pixels or []), *(more_pixels or [])]
    if recordings or pixels_sweep is not None:
        for name, given in (
            ("--spots", spots),
            ("--pictures", pictures),
            ("--mirrors", mirrors),
            ("--report", report),
            ("--nudge", manual or None),
            ("--pixels", recordings[0] if recordings and pixels_sweep is not None else None),
        ):
            if given is not None:
                beside = "--pixels" if pixels_sweep is None else "--pixels-sweep"
                raise InputError(name, str(given), f"no such option beside {beside}")
        if pixels_sweep is not None:
            write_sweep(pixels_sweep, config, json)
        elif pixels:
            calibrate_pixels(recordings, out, config, model, json)
        else:
            raise InputError("calibrate", str(recordings[0]), "--pixels before recordings")
        return
    if model is not None:
        raise InputError("--model", str(model), "--pixels beside it: nothing else depends on the model")
    if mirrors is not None:
        for name, given in (
            ("--spots", spots),
            ("--pictures", pictures),
            ("--report", report),
            ("--nudge", manual or None),
        ):
            if given is not None:
                raise InputError(name, str(given), "no such option beside --mirrors")
        calibrate_servo(mirrors, out, config, json)
        return
    if pictures is not None:
        if spots is not None or manual:
            raise InputError("--pictures", str(pictures), "neither --spots nor --nudge beside it")
        by_camera = calibrate_by_camera(pictures, config)
        write_result(by_camera.fit, str(by_camera.spots), out, report, json, by_camera.stats, by_camera.report_lines)
        return
    if spots is None:
        field = DEFAULT_FIELD_FILE if out is None else out
        result = calibrate_on_board(
            config, field, BoardCalibrationRequest(manual, target_rms_um, spots_max, readings, spot_power_mw)
        )
        write_result(result.fit, str(result.spots), field, report, json, result.stats, result.report_lines)
        delete_session(field)
        return
    if manual:
        raise InputError("--nudge", True, "no such option beside --spots: nothing is measured")
    prior, measured = FieldPrior.from_config(load_config(config)), read_spots(spots)
    check_spots(str(spots), measured, prior)
    fit = fit_field(measured, prior)
    check_fit(str(spots), fit)
    write_result(fit, str(spots), out, report, json)


def write_result(
    fit: "FieldFit",
    source: str,
    out: Path | None,
    report: Path | None,
    json: bool,
    extra_stats: dict[str, object] | None = None,
    extra_lines: tuple[str, ...] = (),
) -> None:
    """Write field and report where asked, and print what is to be said of the fit; more: what its measuring adds."""
    from optodrive.lab.calibration.field_writer import write_field
    from optodrive.lab.calibration.fit_summary import summarize_fit

    stats = summarize_fit(fit) | (extra_stats or {})
    lines = [*format_fit(stats), *extra_lines]
    written = {"field": out, "report": report}
    if out is not None:
        write_field(out, fit, source)
    if report is not None:
        _write_report(report, fit, source, lines)
    if json:
        print_json(stats | {name: str(path) for name, path in written.items() if path is not None})
        return
    for line in lines:
        print(line)
    for path in written.values():
        if path is not None:
            print(f"written          {path}")


def format_fit(stats: dict[str, Any]) -> list[str]:
    """A calibration's figures in plain words."""
    outlier_rows = stats["outlier_rows"]
    lines = [f"spots            {stats['spots']}, {len(outlier_rows)} of them taken for false"]
    if outlier_rows:
        listed = ", ".join(str(row + FIRST_DATA_LINE) for row in outlier_rows[:LISTED_MAX])
        more = f" and {len(outlier_rows) - LISTED_MAX} more" if len(outlier_rows) > LISTED_MAX else ""
        lines.append(f"false            line{'s' if len(outlier_rows) > 1 else ''} {listed}{more}")
    lines += [
        f"residual         {stats['residual_rms_um']:.1f} µm rms, {stats['residual_max_um']:.1f} µm at most",
        f"noise            {stats['noise_um']:.1f} µm on an axis; "
        f"what mirrors, lens and board do not explain {stats['surface_um']:.1f} µm",
        f"one sigma        {stats['sigma_rms_um']:.1f} µm on an axis, {stats['sigma_max_um']:.1f} µm at most; "
        "by region, as seen from the front:",
    ]
    return lines + ["                 " + "".join(f"{value:8.1f}" for value in row) for row in stats["sigma_um"]]


def _write_report(path: Path, fit: "FieldFit", source: str, lines: list[str]) -> None:
    from optodrive.core.files import atomic_write
    from optodrive.core.html_page import render_page, render_table
    from optodrive.lab.calibration.fit_summary import draw_residuals, draw_sigma_map

    geometry, width = fit.field.geometry._asdict(), fit.prior.sigma
    rows = (
        (escape(name), f"{value:.6g}", f"{sigma:.2g}")
        for (name, value), sigma in zip(
            geometry.items(), width * fit.covariance.diagonal()[: len(width)] ** 0.5, strict=True
        )
    )
    body = [
        f"<pre>{escape(chr(10).join(lines))}</pre>",
        "<div class='grid'>",
        f"<figure>{draw_residuals(fit)}<figcaption>Measured less fitted, by where the beam was sent</figcaption></figure>",
        f"<figure>{draw_sigma_map(fit)}<figcaption>One sigma of the beam's place on an axis</figcaption></figure>",
        "</div>",
        "<h2>Parameters</h2><p>Several of them can stand for one another; the field is surer than its parts.</p>",
        render_table(("", "value", "one sigma"), rows, frozenset({1, 2})),
    ]
    with atomic_write(path) as temporary:
        temporary.write_text(
            render_page(f"Calibration from {source}", "field", ["Calibrated field"], body), encoding="utf-8"
        )
