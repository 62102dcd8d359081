"""Pictures of a grid and of the beam: pictures.toml, which describes a folder of them, and their reading."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field as Item
from pydantic import model_validator

from optodrive.core.errors import MISSING, InputError, refuse_os_error
from optodrive.core.extras import import_extra
from optodrive.core.numeric_tables import open_table
from optodrive.core.plausibility import PlausibleRange, check_plausible
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.device.field_geometry import CODE_MAX

PICTURES_FORMAT = "optodrive-pictures"
PICTURES_VERSION = 1
DESCRIPTION_FILE = "pictures.toml"
COLUMNS = ("file", "x_code", "y_code")
CODES_IN_NAME = re.compile(r"(\d+)[_,-](\d+)\.[A-Za-z]+$")
"""Both codes at the end of a picture's name."""
SPOTS_FILE = "spots.csv"
"""File of the folder that receives the measured spots."""
VIEWS_MIN = 3
"""Smallest number of views of the grid, if more than one, that separates the camera's intrinsics from its pose."""

PITCH = PlausibleRange(0.2e-3, 0.1, "m")
Finite = Annotated[float, Item(allow_inf_nan=False)]
FinitePair = tuple[Finite, Finite]
FileName = Annotated[str, Item(min_length=1)]
Image = NDArray[np.uint8] | NDArray[np.uint16]
MEDIAN_PICTURES_MAX = 15
"""Largest number of spot pictures whose median is the background; each spot lies elsewhere."""
MEDIAN_PICTURES_MIN = 3
"""Smallest number of spot pictures whose median is the background."""
MEDIAN_BLOCK_ROWS = 200
"""Rows per block of the median."""


class GridSection(Section):
    """The grid: rows × columns of inner corners or of dots, pitch_m apart. Its first picture shows it in the plane."""

    kind: Literal["chessboard", "circles"]
    rows: Annotated[int, Item(ge=3, le=200)]
    columns: Annotated[int, Item(ge=3, le=200)]
    pitch_m: Annotated[float, Item(gt=0), PITCH]
    pictures: Annotated[tuple[FileName, ...], Item(min_length=1)]


class OriginSection(Section):
    """Position of the grid on the display, as seen from the front.

    marks_px: approximate image positions, in the first picture, of the grid's first corner, of the last corner of the
    first row and of the last corner of the first column; column and row from the upper left
    first_corner_m: position of the first corner from the display's middle; turn_rad: of the rows, anticlockwise
    """

    marks_px: tuple[FinitePair, FinitePair, FinitePair]
    first_corner_m: Annotated[FinitePair, PlausibleRange(0.0, 0.5, "m")]
    turn_rad: Annotated[float, Item(ge=-3.2, le=3.2), PlausibleRange(0.0, 3.2, "rad")] = 0.0


class SpotsSection(Section):
    """The pictures of spots: a table file,x_code,y_code, or a pattern of names that end with both codes."""

    table: FileName | None = None
    pictures: FileName | None = None

    @model_validator(mode="after")
    def _require_exactly_one(self) -> Self:
        if (self.table is None) == (self.pictures is None):
            raise ValueError("exactly one of table and pictures")
        if self.table == SPOTS_FILE:
            raise ValueError(f"a name other than {SPOTS_FILE}, which receives the measured spots")
        return self


class _PicturesFile(Section):
    format: str
    version: int
    dark: FileName | None = None
    grid: GridSection
    origin: OriginSection
    spots: SpotsSection


@dataclass(frozen=True)
class SpotPicture:
    """A picture of the beam's spot, and its codes."""

    path: Path
    x_code: float
    y_code: float


@dataclass(frozen=True)
class PictureFolder:
    """A folder as described by pictures.toml.

    dark: the plane without the beam, None if there is no such picture
    """

    path: Path
    grid: GridSection
    origin: OriginSection
    grid_views: tuple[Path, ...]
    dark: Path | None
    spot_pictures: tuple[SpotPicture, ...]


def read_picture_folder(folder: Path) -> PictureFolder:
    """Read FOLDER/pictures.toml and check that every picture exists. Raise InputError with file, key and value."""
    path = folder / DESCRIPTION_FILE
    table = read_toml(path)
    check_format(path, table, PICTURES_FORMAT, PICTURES_VERSION)
    content = parse_table(path, table, _PicturesFile)
    check_plausible(f"{path}: grid.pitch_m", content.grid.pitch_m, PITCH)
    if 1 < len(content.grid.pictures) < VIEWS_MIN:
        expected = f"1, or at least {VIEWS_MIN}, which the calibration of the camera needs"
        raise InputError(f"{path}: grid.pictures", len(content.grid.pictures), expected)
    views = tuple(_require_picture(folder, name, f"{path}: grid.pictures") for name in content.grid.pictures)
    dark = None if content.dark is None else _require_picture(folder, content.dark, f"{path}: dark")
    table_name = content.spots.table
    rows = _list_by_table(folder, table_name) if table_name else _list_by_name(folder, path, content.spots)
    return PictureFolder(path, content.grid, content.origin, views, dark, rows)


def _require_picture(folder: Path, name: str, where: str) -> Path:
    if not os.path.isfile(folder / name):  # noqa: PTH113 - Path.is_file raises for a path that is too long
        raise InputError(where, name, f"a picture in {folder}")
    return folder / name


def _list_by_name(folder: Path, path: Path, section: SpotsSection) -> tuple[SpotPicture, ...]:
    where, pattern = f"{path}: spots.pictures", str(section.pictures)
    if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        raise InputError(where, pattern, "a pattern of names inside the folder, such as spot_*.png")
    pictures = []
    for picture in sorted(folder.glob(pattern)):
        codes = CODES_IN_NAME.search(picture.name)
        if codes is None:
            raise InputError(where, picture.name, "a name that ends with both codes, such as spot_32768_17404.png")
        x_code, y_code = (_check_code(f"{where}: {picture.name}", float(each)) for each in codes.groups())
        pictures.append(SpotPicture(picture, x_code, y_code))
    if not pictures:
        raise InputError(where, pattern, f"a pattern that matches pictures in {folder}")
    return tuple(pictures)


def _list_by_table(folder: Path, name: str) -> tuple[SpotPicture, ...]:
    path, pictures = folder / name, []
    with open_table(path, COLUMNS) as table:
        for line, (picture, *cells) in table.rows():
            codes = [table.parse_number(line, column, cell) for column, cell in zip(COLUMNS[1:], cells, strict=True)]
            where = f"{path}: row {line}"
            named = zip(COLUMNS[1:], codes, strict=True)
            x_code, y_code = (_check_code(f"{where}: {column}", code) for column, code in named)
            file = _require_picture(folder, picture.strip(), f"{where}: file")
            pictures.append(SpotPicture(file, x_code, y_code))
    return tuple(pictures)


def _check_code(where: str, code: float) -> float:
    if not 0.0 <= code <= CODE_MAX:
        raise InputError(where, code, f"a code, 0 to {CODE_MAX}")
    return code


def import_opencv() -> Any:
    """Import OpenCV. Raise InputError (missing_extra) if it is not installed."""
    return import_extra("cv2", "OpenCV", "camera")


def read_image(path: Path) -> Image:
    """Read a picture as [rows, columns], 8 or 16 bits.

    Of a colour picture it is the blue channel, which holds the beam.
    Raises InputError if OpenCV cannot read it.
    """
    cv2 = import_opencv()
    with refuse_os_error(path, "a readable picture"):
        raw = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    # Ignore the orientation tag: marks_px refer to the picture as the camera stored it.
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(raw, flags) if len(raw) else None
    except cv2.error:
        image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InputError(str(path), "no picture", "a picture that OpenCV reads, 8 or 16 bits (PNG, TIFF, JPEG)")
    blue: Image = image if image.ndim == 2 else np.ascontiguousarray(image[..., 0])
    return blue


class PictureReader:
    """Reads the pictures of one folder, all of one size and depth."""

    def __init__(self, pictures: PictureFolder) -> None:
        self._first = pictures.grid_views[0]
        first = read_image(self._first)
        self.rows, self.columns = first.shape
        self._depth = first.dtype

    def __call__(self, path: Path) -> Image:
        """Read a picture. Raise InputError if its size or depth differs from the first."""
        image = read_image(path)
        if image.shape != (self.rows, self.columns):
            size = f"{image.shape[1]} × {image.shape[0]} pixels"
            raise InputError(str(path), size, f"{self.columns} × {self.rows}, as {self._first.name}")
        if image.dtype != self._depth:
            raise InputError(str(path), str(image.dtype), f"{self._depth}, as {self._first.name}")
        return image

    def read_background(self, pictures: PictureFolder) -> Image:
        """Return the plane without the beam: the dark picture, or the median of pictures of spots."""
        if pictures.dark is not None:
            return self(pictures.dark)
        if len(pictures.spot_pictures) < MEDIAN_PICTURES_MIN:
            expected = f"a picture without the beam, required with only {len(pictures.spot_pictures)} spots"
            raise InputError(f"{pictures.path}: dark", MISSING, expected)
        chosen = np.unique(np.linspace(0, len(pictures.spot_pictures) - 1, MEDIAN_PICTURES_MAX).astype(int))
        stack = np.stack([self(pictures.spot_pictures[at].path) for at in chosen])
        background: Image = np.empty_like(stack[0])
        for first in range(0, self.rows, MEDIAN_BLOCK_ROWS):
            rows = slice(first, first + MEDIAN_BLOCK_ROWS)
            background[rows] = np.median(stack[:, rows].astype(np.float32), axis=0)
        return background
