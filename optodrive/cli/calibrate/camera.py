"""`optodrive calibrate --pictures`: a camera saw a grid in the display's plane, and the beam on it."""

from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.calibrate.board import CalibrationResult
from optodrive.core.errors import InputError
from optodrive.core.units import m_to_um

if TYPE_CHECKING:
    from optodrive.core.types.arrays import BoolArray
    from optodrive.lab.calibration.camera.measure import CameraMeasurement

PicturesOption = Annotated[
    Path | None,
    typer.Option("--pictures", metavar="FOLDER", help="By camera: a grid and the spots, as pictures.toml says."),
]
LISTED_MAX = 6


def calibrate_by_camera(folder: Path, config: str | None) -> CalibrationResult:
    """Measure the spots in pictures, keep them as FOLDER/spots.csv, a file that --spots takes, and fit a field."""
    from optodrive.device.config import load_config
    from optodrive.lab.calibration.camera.folder import SPOTS_FILE
    from optodrive.lab.calibration.camera.measure import measure_folder
    from optodrive.lab.calibration.field_fit import fit_field
    from optodrive.lab.calibration.field_prior import FieldPrior
    from optodrive.lab.calibration.spot_checks import check_fit, check_spots
    from optodrive.lab.calibration.spots import write_spots

    if not folder.is_dir():
        raise InputError("--pictures", str(folder), "a folder with pictures.toml")
    prior = FieldPrior.from_config(load_config(config))
    measured, path = measure_folder(folder), folder / SPOTS_FILE
    write_spots(path, measured.spots)
    check_spots(str(path), measured.spots, prior)
    fit = fit_field(measured.spots, prior)
    check_fit(str(path), fit)
    outliers = [name for name, out in zip(measured.names, fit.outlier, strict=True) if out]
    return CalibrationResult(fit, path, build_stats(measured, outliers, path), format_stats(measured, outliers, path))


def build_stats(measured: "CameraMeasurement", outliers: list[str], path: Path) -> dict[str, object]:
    """What the camera adds, for --json."""
    return {
        "spots_file": str(path),
        "outlier_pictures": outliers,
        "outside_pictures": _select_names(measured, measured.is_outside),
        "saturated_pictures": _select_names(measured, measured.is_saturated),
        "grid_pictures": measured.view_count,
        "pixel_um": round(m_to_um(measured.pixel_scale_m), 3),
        "corners_rms_px": round(measured.plane.residual_px, 4),
        "spot_sigma_um": [round(m_to_um(each), 3) for each in measured.sigma_m.tolist()],
    }


def format_stats(measured: "CameraMeasurement", outliers: list[str], path: Path) -> tuple[str, ...]:
    """The same in words."""
    sigma_um = sorted(m_to_um(each) for each in measured.sigma_m.tolist())
    report = [
        f"camera           {m_to_um(measured.pixel_scale_m):.0f} µm a pixel; corners of the grid "
        f"{measured.plane.residual_px:.2f} px off on an axis, from {measured.view_count} of its pictures",
        f"centres          sure to {median(sigma_um):.1f} µm on an axis, {sigma_um[-1]:.1f} µm at worst",
    ]
    for name, which in (
        ("false pictures", outliers),
        ("saturated", _select_names(measured, measured.is_saturated)),
        ("warning", _select_names(measured, measured.is_outside)),
    ):
        if which:
            outside = " outside the grid: the camera is only guessed there" if name == "warning" else ""
            report.append(f"{name:<17}{_join_names(which)}{outside}")
    return (*report, f"spots kept       {path}")


def _select_names(measured: "CameraMeasurement", mask: "BoolArray") -> list[str]:
    return [name for name, chosen in zip(measured.names, mask, strict=True) if chosen]


def _join_names(names: list[str]) -> str:
    more = f" and {len(names) - LISTED_MAX} more" if len(names) > LISTED_MAX else ""
    return ", ".join(names[:LISTED_MAX]) + more
