"""Pixel map, the file pixels.toml: gain, aim offset and state of every pixel of a display."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

import numpy as np
from pydantic import Field as Item

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.files import write_text
from optodrive.core.plausibility import PlausibleRange
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.core.types.arrays import BoolArray, FloatArray, ReadOnlyArrays, StrArray
from optodrive.device.config import Config, PixelLayout, build_pixel_layout
from optodrive.device.config_sections import DisplaySection, Pitch

FORMAT = "optodrive-pixels"
VERSION = 1
BYTES_MAX = 16_000_000
"""Largest size of a file, bytes: 40,000 pixels with every value."""
GAIN_MIN, GAIN_MAX = 0.2, 5.0
"""Range of plausible gains; a pixel with a lower gain is dead."""
MEASURED, DEAD, NOT_MEASURED = "measured", "dead", "not measured"


Offset = Annotated[float, PlausibleRange(0.0, 5e-3, "m")]


class MappedPixel(Section):
    """One pixel of a map."""

    index: Annotated[int, Item(ge=0)]


class MappedPixels(Section):
    """All pixels of a display, in order."""

    pixels: tuple[MappedPixel, ...]


class _Pixel(MappedPixel):
    state: Literal["measured", "dead", "not measured"] = "measured"
    gain: Annotated[float, Item(ge=GAIN_MIN, le=GAIN_MAX)] = 1.0
    gain_sigma: Annotated[float, Item(ge=0)] | None = None
    offset_x_m: Offset = 0.0
    offset_y_m: Offset = 0.0
    offset_x_sigma_m: Annotated[Offset, Item(ge=0)] | None = None
    offset_y_sigma_m: Annotated[Offset, Item(ge=0)] | None = None


class MappedDisplay(Section):
    """The display that a map of pixels belongs to."""

    name: str
    rows: int
    columns: int
    pitch_m: Pitch
    missing: tuple[tuple[int, int], ...]


class _Model(Section):
    parameters: str


class MapFile(Section):
    """A file with numbers of every pixel of one display, and their origin."""

    format: str
    version: int
    about: dict[str, str | float | int] = Item(default_factory=dict)
    display: MappedDisplay
    map: MappedPixels


class _Map(MappedPixels):
    pixels: tuple[_Pixel, ...]


class _PixelMapFile(MapFile):
    model: _Model
    map: _Map


File = TypeVar("File", bound=MapFile)
NUMERIC_FIELDS = ("gain", "gain_sigma", "offset_x_m", "offset_y_m", "offset_x_sigma_m", "offset_y_sigma_m")


@dataclass(frozen=True, eq=False)
class PixelMap(ReadOnlyArrays):
    """Gain, aim offset and state of every pixel, all [p].

    gain: peak displacement over that of the model; offset: aim point relative to the pixel's centre, m; sigma: standard
    uncertainties, NaN without a measurement; state: MEASURED, DEAD or NOT_MEASURED; model: name of the parameter set
    that the gains refer to, "" if all are 1
    """

    gain: FloatArray
    gain_sigma: FloatArray
    offset_x_m: FloatArray
    offset_y_m: FloatArray
    offset_x_sigma_m: FloatArray
    offset_y_sigma_m: FloatArray
    state: StrArray
    model: str = ""

    def __len__(self) -> int:
        return len(self.gain)

    @classmethod
    def uniform(cls, count: int, offset_x_m: float = 0.0, offset_y_m: float = 0.0) -> Self:
        """Return a map of unmeasured pixels with one common aim offset."""
        unknown = np.full(count, np.nan)
        offsets = np.full(count, offset_x_m), np.full(count, offset_y_m)
        state = np.full(count, NOT_MEASURED)
        return cls(np.ones(count), unknown, *offsets, unknown.copy(), unknown.copy(), state)

    @property
    def dead(self) -> BoolArray:
        """Mask of the dead pixels, [p]."""
        return np.asarray(self.state == DEAD, dtype=np.bool_)

    @property
    def displacement_factor(self) -> FloatArray:
        """Factor on the model's displacement, [p]: the gain, or 0 for a dead pixel."""
        # On the displacement alone: heights cannot tell a stiff membrane from a pale absorber, so heat stays the
        # model's.
        return np.where(self.dead, 0.0, self.gain)


def remove_pixel_map(config: Config) -> Config:
    """Return the configuration without a pixel map."""
    return replace_pixel_map(config, None)


def replace_pixel_map(config: Config, path: Path | None) -> Config:
    """Return the configuration with another pixel map file, or with none."""
    display = config.display.model_copy(update={"pixel_map": None if path is None else str(path)})
    return config.model_copy(update={"display": display})


def load_pixel_map(config: Config) -> PixelMap | None:
    """Load the pixel map that a configuration names and check it against the display. Return None if it names none."""
    if config.display.pixel_map is None:
        return None
    path = Path(config.display.pixel_map)
    return _build_map(path, read_map_file(path, _PixelMapFile, FORMAT, config), config)


def build_aim_layout(config: Config) -> PixelLayout:
    """Return the aim points of all pixels as a layout. Raise InputError as `load_pixel_map`."""
    layout, pixel_map = build_pixel_layout(config.display), load_pixel_map(config)
    if pixel_map is None:
        return layout
    return PixelLayout(layout.x_m + pixel_map.offset_x_m, layout.y_m + pixel_map.offset_y_m, layout.row, layout.column)


def max_aim_offset_m(config: Config) -> tuple[float, float]:
    """Return the largest aim offset in x and y that keeps the focus within the pixel's cell, m."""
    pitch_m, laser = config.display.pitch_m, config.laser
    return (pitch_m - laser.focus_width_m) / 2.0, (pitch_m - laser.focus_height_m) / 2.0


def write_pixel_map(path: Path, pixel_map: PixelMap, config: Config, about: dict[str, str | float | int]) -> None:
    """Write pixels.toml atomically.

    about: informative entries, text without quotes or backslashes
    """
    lines = [f'format = "{FORMAT}"', f"version = {VERSION}", "", *format_map_head(config, about)]
    lines += ["", "[model] # the parameter set that the gains refer to", f'parameters = "{pixel_map.model}"']
    lines += ["", "[map]", "pixels = ["]
    lines += [f"  {{ {_format_entry(pixel_map, index)} }}," for index in range(len(pixel_map))]
    write_text(path, "\n".join([*lines, "]"]) + "\n")


def format_map_head(config: Config, about: dict[str, str | float | int]) -> list[str]:
    """Return the lines of the tables [about] and [display] of a map of pixels."""
    display = config.display
    lines = ["[about]"]
    lines += [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value!r}" for key, value in about.items()]
    lines += ["", "[display] # of the map", f'name = "{config.name}"', f"rows = {display.rows}"]
    lines += [f"columns = {display.columns}", f"pitch_m = {display.pitch_m!r}"]
    return [*lines, f"missing = {[list(place) for place in display.missing]}"]


def _format_entry(pixel_map: PixelMap, index: int) -> str:
    parts = [f"index = {index}", f'state = "{pixel_map.state[index]}"']
    for name in NUMERIC_FIELDS:
        value = float(getattr(pixel_map, name)[index])
        if np.isfinite(value):
            parts.append(f"{name} = {value:.6g}")
    return ", ".join(parts)


def read_change(path: Path) -> tuple[int, int]:
    """Return a file's time of change, ns, and its size, which tell whether it was changed. Raise InputError."""
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise InputError(
            str(path), Unquoted(getattr(error, "strerror", None) or str(error)), "a readable file"
        ) from None
    return status.st_mtime_ns, status.st_size


# By time and size of the file: layout, field and table of each stage ask for the map again.
@lru_cache(maxsize=16)
def _read_file(path: Path, kind: type[MapFile], form: str, _changed_ns: int, _size: int) -> MapFile:
    table = read_toml(path, BYTES_MAX)
    check_format(path, table, form, VERSION)
    return parse_table(path, table, kind)


def read_map_file(path: Path, kind: type[File], form: str, config: Config) -> File:
    """Read a map of pixels. form: its format. Raise InputError unless it belongs to the configured display."""
    content = _read_file(path, kind, form, *read_change(path))
    assert isinstance(content, kind)  # noqa: S101 - the cache does not know the kind
    _check_mapped_display(path, content.display, config)
    count = len(build_pixel_layout(config.display))
    if [pixel.index for pixel in content.map.pixels] != list(range(count)):
        expected = f"one entry per pixel, 0 to {count - 1} in order"
        raise InputError(f"{path}: map.pixels", f"{len(content.map.pixels)} entries", expected)
    return content


def _check_mapped_display(path: Path, mapped: MappedDisplay, config: Config) -> None:
    display: DisplaySection = config.display
    for key in ("rows", "columns", "pitch_m"):
        given, expected = getattr(mapped, key), getattr(display, key)
        if abs(given - expected) > 1e-9:
            message = f"{expected}, the value of {config.name}: this is a map of {mapped.name}"
            raise InputError(f"{path}: display.{key}", given, message)
    if set(mapped.missing) != set(display.missing):
        message = f"the {len(display.missing)} missing places of {config.name}: this is a map of {mapped.name}"
        raise InputError(f"{path}: display.missing", f"{len(mapped.missing)} places", message)


def _build_map(path: Path, content: _PixelMapFile, config: Config) -> PixelMap:
    pixels = content.map.pixels
    numbers = {
        name: np.array([np.nan if (value := getattr(pixel, name)) is None else value for pixel in pixels])
        for name in NUMERIC_FIELDS
    }
    for axis, max_m in zip("xy", max_aim_offset_m(config), strict=True):
        distance_m = np.abs(numbers[f"offset_{axis}_m"])
        # Within the own cell: the light of one pixel must not count as another's.
        if distance_m.max() > max_m:
            at = int(distance_m.argmax())
            message = f"at most {max_m:.6g} in either direction, so that the focus stays within the pixel's own cell"
            raise InputError(f"{path}: pixel {at}: offset_{axis}_m", float(numbers[f"offset_{axis}_m"][at]), message)
    state = np.array([pixel.state for pixel in pixels])
    if np.all(state == DEAD):
        raise InputError(f"{path}: map.pixels", "dead pixels only", "at least one live pixel")
    return PixelMap(**numbers, state=state, model=content.model.parameters)
