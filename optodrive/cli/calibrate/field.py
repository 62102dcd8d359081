"""`optodrive calibrate`: measured spots to a calibrated field, and what is to be said of it."""

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.calibrate.board import (
    FIELD,
    GoalOption,
    NudgeOption,
    OnBoard,
    ReadingsOption,
    SpotPowerOption,
    SpotsMaxOption,
    calibrated_on_board,
    session_over,
)
from optodrive.cli.calibrate.camera import PicturesOption, measured_by_camera
from optodrive.cli.calibrate.pixels import MorePixelsArgument, PixelsOption, SweepOption, calibrated_pixels, write_sweep
from optodrive.cli.calibrate.servo import calibrated_mirrors
from optodrive.cli.options import ConfigOption, JsonOption, ModelOption, print_json
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.lab.calibration.field_fit import FieldFit

LISTED_MAX = 12
HEAD_LINES = 2
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
    nudge: NudgeOption = False,
    goal_um: GoalOption = 10.0,
    spots_max: SpotsMaxOption = 25,
    readings: ReadingsOption = 3,
    spot: SpotPowerOption = 5.0,
) -> None:
    """Fit a field to measured spots, to pictures of them, or measure on the board first.

    Or find the mirrors' servos, or each pixel's gain and offset.
    """
    from optodrive.device.config import load_config
    from optodrive.lab.calibration.field_fit import fit_field
    from optodrive.lab.calibration.field_prior import Prior
    from optodrive.lab.calibration.spot_checks import check_fit, check_spots
    from optodrive.lab.calibration.spots import read_spots

    recordings = [*(pixels or []), *(more_pixels or [])]
    if recordings or pixels_sweep is not None:
        for name, given in (
            ("--spots", spots),
            ("--pictures", pictures),
            ("--mirrors", mirrors),
            ("--report", report),
            ("--nudge", nudge or None),
            ("--pixels", recordings[0] if recordings and pixels_sweep is not None else None),
        ):
            if given is not None:
                beside = "--pixels" if pixels_sweep is None else "--pixels-sweep"
                raise InputError(name, str(given), f"no such option beside {beside}")
        if pixels_sweep is not None:
            write_sweep(pixels_sweep, config, json)
        elif pixels:
            calibrated_pixels(recordings, out, config, model, json)
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
            ("--nudge", nudge or None),
        ):
            if given is not None:
                raise InputError(name, str(given), "no such option beside --mirrors")
        calibrated_mirrors(mirrors, out, config, json)
        return
    if pictures is not None:
        if spots is not None or nudge:
            raise InputError("--pictures", str(pictures), "neither --spots nor --nudge beside it")
        by_camera = measured_by_camera(pictures, config)
        tell(by_camera.fit, str(by_camera.spots), out, report, json, by_camera.figures, by_camera.lines)
        return
    if spots is None:
        field = FIELD if out is None else out
        told = calibrated_on_board(config, field, OnBoard(nudge, goal_um, spots_max, readings, spot))
        tell(told.fit, str(told.spots), field, report, json, told.figures, told.lines)
        session_over(field)
        return
    if nudge:
        raise InputError("--nudge", True, "no such option beside --spots: nothing is measured")
    prior, measured = Prior.of(load_config(config)), read_spots(spots)
    check_spots(str(spots), measured, prior)
    fit = fit_field(measured, prior)
    check_fit(str(spots), fit)
    tell(fit, str(spots), out, report, json)


def tell(
    fit: "FieldFit",
    source: str,
    out: Path | None,
    report: Path | None,
    json: bool,
    more: dict[str, object] | None = None,
    more_lines: tuple[str, ...] = (),
) -> None:
    """Write field and report where asked, and print what is to be said of the fit; more: what its measuring adds."""
    from optodrive.lab.calibration.field_writer import write_field
    from optodrive.lab.calibration.fit_summary import summary

    figures = summary(fit) | (more or {})
    lines = [*report_lines(figures), *more_lines]
    written = {"field": out, "report": report}
    if out is not None:
        write_field(out, fit, source)
    if report is not None:
        _write_report(report, fit, source, lines)
    if json:
        print_json(figures | {name: str(path) for name, path in written.items() if path is not None})
        return
    for line in lines:
        print(line)
    for path in written.values():
        if path is not None:
            print(f"written          {path}")


def report_lines(figures: dict[str, Any]) -> list[str]:
    """A calibration's figures in plain words."""
    false = figures["outlier_rows"]
    lines = [f"spots            {figures['spots']}, {len(false)} of them taken for false"]
    if false:
        listed = ", ".join(str(row + HEAD_LINES) for row in false[:LISTED_MAX])
        more = f" and {len(false) - LISTED_MAX} more" if len(false) > LISTED_MAX else ""
        lines.append(f"false            line{'s' if len(false) > 1 else ''} {listed}{more}")
    lines += [
        f"residual         {figures['residual_rms_um']:.1f} µm rms, {figures['residual_max_um']:.1f} µm at most",
        f"noise            {figures['noise_um']:.1f} µm on an axis; "
        f"what mirrors, lens and board do not explain {figures['surface_um']:.1f} µm",
        f"one sigma        {figures['sigma_rms_um']:.1f} µm on an axis, {figures['sigma_max_um']:.1f} µm at most; "
        "by region, as seen from the front:",
    ]
    return lines + ["                 " + "".join(f"{value:8.1f}" for value in row) for row in figures["sigma_um"]]


def _write_report(path: Path, fit: "FieldFit", source: str, lines: list[str]) -> None:
    from optodrive.core.files import written_whole
    from optodrive.core.html_page import page, table
    from optodrive.lab.calibration.fit_summary import heat_map, quiver

    geometry, width = fit.field.geometry._asdict(), fit.prior.width
    rows = (
        (escape(name), f"{value:.6g}", f"{sigma:.2g}")
        for (name, value), sigma in zip(
            geometry.items(), width * fit.covariance.diagonal()[: len(width)] ** 0.5, strict=True
        )
    )
    body = [
        f"<pre>{escape(chr(10).join(lines))}</pre>",
        "<div class='grid'>",
        f"<figure>{quiver(fit)}<figcaption>Measured less fitted, by where the beam was sent</figcaption></figure>",
        f"<figure>{heat_map(fit)}<figcaption>One sigma of the beam's place on an axis</figcaption></figure>",
        "</div>",
        "<h2>Parameters</h2><p>Several of them can stand for one another; the field is surer than its parts.</p>",
        table(("", "value", "one sigma"), rows, frozenset({1, 2})),
    ]
    with written_whole(path) as temporary:
        temporary.write_text(page(f"Calibration from {source}", "field", ["Calibrated field"], body), encoding="utf-8")
