"""`optodrive calibrate --pictures`: a camera saw a grid in the display's plane, and the beam on it."""

from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.calibrate.board import Told
from optodrive.core.errors import InputError
from optodrive.core.units import m_to_um

if TYPE_CHECKING:
    from optodrive.core.types.arrays import BoolArray
    from optodrive.lab.calibration.camera.measure import Measured

PicturesOption = Annotated[
    Path | None,
    typer.Option("--pictures", metavar="FOLDER", help="By camera: a grid and the spots, as pictures.toml says."),
]
LISTED_MAX = 6


def measured_by_camera(folder: Path, config: str | None) -> Told:
    """Measure the spots in pictures, keep them as FOLDER/spots.csv, a file that --spots takes, and fit a field."""
    from optodrive.device.config import load_config
    from optodrive.lab.calibration.camera.folder import SPOTS
    from optodrive.lab.calibration.camera.measure import measure_folder
    from optodrive.lab.calibration.field_fit import fit_field
    from optodrive.lab.calibration.field_prior import Prior
    from optodrive.lab.calibration.spot_checks import check_fit, check_spots
    from optodrive.lab.calibration.spots import write_spots

    if not folder.is_dir():
        raise InputError("--pictures", str(folder), "a folder with pictures.toml")
    prior = Prior.of(load_config(config))
    measured, path = measure_folder(folder), folder / SPOTS
    write_spots(path, measured.spots)
    check_spots(str(path), measured.spots, prior)
    fit = fit_field(measured.spots, prior)
    check_fit(str(path), fit)
    false = [name for name, out in zip(measured.names, fit.outlier, strict=True) if out]
    return Told(fit, path, figures(measured, false, path), lines(measured, false, path))


def figures(measured: "Measured", false: list[str], path: Path) -> dict[str, object]:
    """What the camera adds, for --json."""
    return {
        "spots_file": str(path),
        "outlier_pictures": false,
        "outside_pictures": _named(measured, measured.outside),
        "saturated_pictures": _named(measured, measured.saturated),
        "grid_pictures": measured.views,
        "pixel_um": round(m_to_um(measured.scale_m), 3),
        "corners_rms_px": round(measured.plane.left_px, 4),
        "spot_sigma_um": [round(m_to_um(each), 3) for each in measured.sigma_m.tolist()],
    }


def lines(measured: "Measured", false: list[str], path: Path) -> tuple[str, ...]:
    """The same in words."""
    sigma_um = sorted(m_to_um(each) for each in measured.sigma_m.tolist())
    told = [
        f"camera           {m_to_um(measured.scale_m):.0f} µm a pixel; corners of the grid "
        f"{measured.plane.left_px:.2f} px off on an axis, from {measured.views} of its pictures",
        f"centres          sure to {median(sigma_um):.1f} µm on an axis, {sigma_um[-1]:.1f} µm at worst",
    ]
    for name, which in (
        ("false pictures", false),
        ("saturated", _named(measured, measured.saturated)),
        ("warning", _named(measured, measured.outside)),
    ):
        if which:
            outside = " outside the grid: the camera is only guessed there" if name == "warning" else ""
            told.append(f"{name:<17}{_listed(which)}{outside}")
    return (*told, f"spots kept       {path}")


def _named(measured: "Measured", which: "BoolArray") -> list[str]:
    return [name for name, chosen in zip(measured.names, which, strict=True) if chosen]


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - LISTED_MAX} more" if len(names) > LISTED_MAX else ""
    return ", ".join(names[:LISTED_MAX]) + more
