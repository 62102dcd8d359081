"""The file field.toml, which holds a calibrated field."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field as Item

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.plausibility import PlausibleRange
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.device.calibrated_field import ORDER, TERM_COUNT, CalibratedField, Extent
from optodrive.device.config_sections import FocalLength, Wiring
from optodrive.device.field_geometry import GEOMETRY_RANGES, FieldGeometry

FORMAT = "optodrive-field"
VERSION = 1


Code = Annotated[float, Item(ge=-1e5, le=1e5)]
HalfRange = Annotated[float, Item(ge=1, le=1e5)]
Coefficient = Annotated[float, Item(ge=-1e3, le=1e3)]
PIXEL_OFFSET = PlausibleRange(0.0, 5e-3, "m")
Displacement = Annotated[float, Item(ge=-1, le=1), PIXEL_OFFSET]


class _Scanner(Section):
    rad_per_code: Annotated[float, Item(gt=0), PlausibleRange(3e-8, 4e-4, "rad")]
    focal_length_m: FocalLength
    swap_axes: bool = False
    invert_x: bool = False
    invert_y: bool = False


class _Extent(Section):
    x_code: Code
    y_code: Code
    x_half: HalfRange
    y_half: HalfRange


class _Surface(Section):
    order: Literal[6]
    x_m: Annotated[tuple[Displacement, ...], Item(min_length=TERM_COUNT, max_length=TERM_COUNT)]
    y_m: Annotated[tuple[Displacement, ...], Item(min_length=TERM_COUNT, max_length=TERM_COUNT)]


class _Uncertainty(Section):
    sigma_m: Annotated[tuple[tuple[Annotated[float, Item(gt=0, le=1), PIXEL_OFFSET], ...], ...], Item(min_length=2)]


class _FieldFile(Section):
    format: str
    version: int
    about: dict[str, str | float | int] = Item(default_factory=dict)
    scanner: _Scanner
    extent: _Extent
    geometry: Annotated[dict[str, Coefficient], GEOMETRY_RANGES]
    surface: _Surface
    uncertainty: _Uncertainty


def strip_toml_specials(text: str) -> str:
    """Return the text without characters that a basic TOML string cannot hold."""
    return "".join(letter for letter in text if letter.isprintable() and letter not in '"\\')


def format_field(field: CalibratedField, about: dict[str, str | float | int]) -> str:
    """Return a field as TOML of format optodrive-field, version 1."""
    extent = field.extent
    if field.display:
        about = {"display": strip_toml_specials(field.display), **about}
    lines = [f'format = "{FORMAT}"', f"version = {VERSION}", "", "[about]"]
    lines += [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value!r}" for key, value in about.items()]
    lines += ["", "[scanner] # of the configuration that it was calibrated with"]
    lines += [f"rad_per_code = {field.rad_per_code!r}", f"focal_length_m = {field.focal_length_m!r}"]
    lines += [f"{key} = {str(value).lower()}" for key, value in field.wiring._asdict().items()]
    lines += ["", "[extent] # codes for which it is calibrated"]
    lines += [f"{key} = {float(getattr(extent, key))!r}" for key in ("x_code", "y_code", "x_half", "y_half")]
    lines += ["", "[geometry]"]
    lines += [f"{key} = {value!r}" for key, value in field.geometry._asdict().items()]
    lines += ["", "[surface] # Legendre products of total degree 2 to order, each of mean square 1", f"order = {ORDER}"]
    lines += [f"{axis}_m = {row.tolist()!r}" for axis, row in zip("xy", field.surface_m, strict=True)]
    lines += ["", "[uncertainty] # standard uncertainty per axis over the extent, rows by y", "sigma_m = ["]
    lines += [f"  [{', '.join(f'{value:.4g}' for value in row)}]," for row in field.sigma_grid_m.tolist()]
    return "\n".join([*lines, "]"]) + "\n"


def load_field(path: Path) -> CalibratedField:
    """Load field.toml. Raise InputError for another format or version, and for invalid content."""
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    content = parse_table(path, table, _FieldFile)
    differing = set(FieldGeometry._fields) ^ set(content.geometry)
    if differing:
        raise InputError(
            f"{path}: geometry", ", ".join(sorted(differing)), f"exactly {', '.join(FieldGeometry._fields)}"
        )
    grid = content.uncertainty.sigma_m
    if any(len(row) != len(grid) for row in grid):
        raise InputError(f"{path}: uncertainty.sigma_m", [len(row) for row in grid], "as many columns as rows")
    field = CalibratedField(
        geometry=FieldGeometry(**content.geometry),
        surface_m=np.array([content.surface.x_m, content.surface.y_m]),
        extent=Extent(**content.extent.model_dump()),
        rad_per_code=content.scanner.rad_per_code,
        focal_length_m=content.scanner.focal_length_m,
        sigma_grid_m=np.array(grid),
        display=str(content.about.get("display", "")),
        wiring=Wiring(*(getattr(content.scanner, key) for key in Wiring._fields)),
    )
    if not field.is_finite:
        raise InputError(
            f"{path}: geometry and surface",
            Unquoted("infinite or equal positions"),
            "one position on the display per code",
        )
    return field
