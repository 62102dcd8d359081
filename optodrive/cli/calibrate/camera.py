"""`optodrive calibrate camera`: measure spots in pictures of a grid and of the beam, then fit a field."""

from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.calibrate.field import (
    FieldCalibration,
    FieldOutOption,
    ReportOption,
    check_calibration_outputs,
    write_calibration,
)
from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.core.errors import InputError
from optodrive.core.quantity import m_to_um

if TYPE_CHECKING:
    from optodrive.core.types.arrays import BoolArray
    from optodrive.lab.calibration.picture_spots import CameraMeasurement

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
    outliers = [name for name, is_outlier in zip(measured.names, fit.outlier, strict=True) if is_outlier]
    return FieldCalibration(
        fit,
        path,
        build_camera_stats(measured, outliers, path),
        format_camera_stats(measured, outliers, path, replaced),
    )


def build_camera_stats(measured: "CameraMeasurement", outliers: list[str], spots_file: Path) -> dict[str, object]:
    """Build the statistics that the camera adds to those of the fit, for --json."""
    return {
        "spots_file": str(spots_file),
        "outlier_pictures": outliers,
        "outside_pictures": _select_names(measured, measured.is_outside),
        "saturated_pictures": _select_names(measured, measured.is_saturated),
        "grid_pictures": measured.view_count,
        "pixel_um": round(m_to_um(measured.pixel_scale_m), 3),
        "corners_rms_px": round(measured.plane.residual_px, 4),
        "spot_sigma_um": [round(m_to_um(sigma_m), 3) for sigma_m in measured.sigma_m.tolist()],
    }


def format_camera_stats(
    measured: "CameraMeasurement", outliers: list[str], spots_file: Path, replaced: bool
) -> tuple[str, ...]:
    """Format the statistics of the camera as text lines.

    replaced: whether the spots of an earlier measurement were in the file
    """
    sigma_um = sorted(m_to_um(sigma_m) for sigma_m in measured.sigma_m.tolist())
    lines = [
        f"camera           {m_to_um(measured.pixel_scale_m):.0f} µm per pixel; grid corners "
        f"{measured.plane.residual_px:.2f} px rms per axis, "
        f"from {measured.view_count} picture{'s' if measured.view_count > 1 else ''}",
        f"centroids        sigma {median(sigma_um):.1f} µm per axis, {sigma_um[-1]:.1f} µm max",
    ]
    saturated, outside = (_select_names(measured, mask) for mask in (measured.is_saturated, measured.is_outside))
    if outliers:
        lines.append(f"outlier pictures {_join_names(outliers)}")
    if saturated:
        lines.append(f"saturated        {_join_names(saturated)}")
    if outside:
        lines.append(
            f"warning          {_join_names(outside)} outside the grid: the camera model is extrapolated there"
        )
    return (*lines, f"spots {'replaced' if replaced else 'written '}   {spots_file}")


def _select_names(measured: "CameraMeasurement", mask: "BoolArray") -> list[str]:
    return [name for name, is_selected in zip(measured.names, mask, strict=True) if is_selected]


def _join_names(names: list[str]) -> str:
    omitted = len(names) - NAMES_LISTED_MAX
    return ", ".join(names[:NAMES_LISTED_MAX]) + (f" and {omitted} more" if omitted > 0 else "")
