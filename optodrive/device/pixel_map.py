"""pixels.toml: how high each pixel of a display stands against the model, where to aim at it, whether it lives."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field as Item
from pydantic import ValidationError

from optodrive.core.errors import InputError
from optodrive.core.files import atomic_write, read_toml
from optodrive.core.types.arrays import BoolArray, FloatArray, StrArray, freeze_arrays
from optodrive.device.config import (
    Config,
    DisplaySection,
    PixelLayout,
    Section,
    build_input_error,
    build_pixel_layout,
    check_format,
)

FORMAT = "optodrive-pixels"
VERSION = 1
GAIN_MIN, GAIN_MAX = 0.2, 5.0
"""A pixel that responds less is dead; one that responds more is nothing that one should plan with."""
MEASURED, DEAD, NOT_MEASURED = "measured", "dead", "not measured"


class _Pixel(Section):
    index: Annotated[int, Item(ge=0)]
    state: Literal["measured", "dead", "not measured"] = "measured"
    gain: Annotated[float, Item(ge=GAIN_MIN, le=GAIN_MAX)] = 1.0
    gain_sigma: Annotated[float, Item(ge=0)] | None = None
    offset_x_m: float = 0.0
    offset_y_m: float = 0.0
    offset_x_sigma_m: Annotated[float, Item(ge=0)] | None = None
    offset_y_sigma_m: Annotated[float, Item(ge=0)] | None = None


class _Display(Section):
    name: str
    rows: int
    columns: int
    pitch_m: float
    missing: tuple[tuple[int, int], ...]


class _Model(Section):
    parameters: str


class _Map(Section):
    pixels: tuple[_Pixel, ...]


class _PixelMapFile(Section):
    format: str
    version: int
    about: dict[str, str | float | int] = Item(default_factory=dict)
    display: _Display
    model: _Model
    map: _Map


NUMERIC_FIELDS = ("gain", "gain_sigma", "offset_x_m", "offset_y_m", "offset_x_sigma_m", "offset_y_sigma_m")


@dataclass(frozen=True, eq=False)
class PixelMap:
    """All [p]. gain: peak displacement over the model's; offset: where to aim, from the pixel's middle, m.

    sigma: standard uncertainties, NaN where nothing was measured; state: MEASURED, DEAD or NOT_MEASURED
    model: name of the parameter set that gains are against, "" where all are 1
    """

    gain: FloatArray
    gain_sigma: FloatArray
    offset_x_m: FloatArray
    offset_y_m: FloatArray
    offset_x_sigma_m: FloatArray
    offset_y_sigma_m: FloatArray
    state: StrArray
    model: str = ""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.gain)

    @classmethod
    def uniform(cls, count: int, offset_x_m: float = 0.0, offset_y_m: float = 0.0) -> Self:
        """Pixels of which nothing is known, all aimed at the same way off their middle."""
        unknown = np.full(count, np.nan)
        offsets = np.full(count, offset_x_m), np.full(count, offset_y_m)
        state = np.full(count, NOT_MEASURED)
        return cls(np.ones(count), unknown, *offsets, unknown.copy(), unknown.copy(), state)

    @property
    def dead(self) -> BoolArray:
        """Which are dead, [p]."""
        return np.asarray(self.state == DEAD, dtype=np.bool_)

    @property
    def displacement_factor(self) -> FloatArray:
        """Factor on the model's displacement, [p]: the gain, 0 where dead."""
        return np.where(self.dead, 0.0, self.gain)


def remove_pixel_map(config: Config) -> Config:
    """The configuration as if no pixel were known better than the model."""
    return replace_pixel_map(config, None)


def replace_pixel_map(config: Config, path: Path | None) -> Config:
    """The configuration with the file of another map, or none."""
    display = config.display.model_copy(update={"pixel_map": None if path is None else str(path)})
    return config.model_copy(update={"display": display})


def load_pixel_map(config: Config) -> PixelMap | None:
    """The map that a configuration names, held against its display; None where it names none."""
    if config.display.pixel_map is None:
        return None
    path = Path(config.display.pixel_map)
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    content = _read_file(path, status.st_mtime_ns, status.st_size)
    _check_display(path, content.display, config)
    return _build_map(path, content, config)


def build_aim_layout(config: Config) -> PixelLayout:
    """Where the beam is sent for each pixel, display metres; raises as `map_of`."""
    layout, known = build_pixel_layout(config.display), load_pixel_map(config)
    if known is None:
        return layout
    return PixelLayout(layout.x_m + known.offset_x_m, layout.y_m + known.offset_y_m, layout.row, layout.column)


def max_aim_offset_m(config: Config) -> tuple[float, float]:
    """The farthest that the beam may be aimed from a pixel's middle, x and y: the focus stays in the pixel's cell."""
    pitch_m, laser = config.display.pitch_m, config.laser
    return (pitch_m - laser.focus_width_m) / 2.0, (pitch_m - laser.focus_height_m) / 2.0


def write_pixel_map(path: Path, pixel_map: PixelMap, config: Config, about: dict[str, str | float | int]) -> None:
    """Write pixels.toml, whole or not at all. about: for people; text without quotes or backslashes."""
    display = config.display
    lines = [f'format = "{FORMAT}"', f"version = {VERSION}", "", "[about]"]
    lines += [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value!r}" for key, value in about.items()]
    lines += ["", "[display] # the one it is a map of", f'name = "{config.name}"', f"rows = {display.rows}"]
    lines += [f"columns = {display.columns}", f"pitch_m = {display.pitch_m!r}"]
    lines += [f"missing = {[list(place) for place in display.missing]}"]
    lines += ["", "[model] # the parameter set that gains are against", f'parameters = "{pixel_map.model}"']
    lines += ["", "[map]", "pixels = ["]
    lines += [f"  {{ {_format_entry(pixel_map, index)} }}," for index in range(len(pixel_map))]
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join([*lines, "]"]) + "\n", encoding="utf-8")


def _format_entry(pixel_map: PixelMap, index: int) -> str:
    parts = [f"index = {index}", f'state = "{pixel_map.state[index]}"']
    for name in NUMERIC_FIELDS:
        value = float(getattr(pixel_map, name)[index])
        if np.isfinite(value):
            parts.append(f"{name} = {value:.6g}")
    return ", ".join(parts)


@lru_cache(maxsize=8)
def _read_file(path: Path, _changed_ns: int, _size: int) -> _PixelMapFile:
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    try:
        return _PixelMapFile.model_validate(table)
    except ValidationError as error:
        raise build_input_error(error, str(path), _PixelMapFile) from None


def _check_display(path: Path, made_for: _Display, config: Config) -> None:
    own: DisplaySection = config.display
    for key in ("rows", "columns", "pitch_m"):
        given, expected = getattr(made_for, key), getattr(own, key)
        if abs(given - expected) > 1e-9:
            words = f"{expected}, that of {config.name}: this is a map of {made_for.name}"
            raise InputError(f"{path}: display.{key}", given, words)
    if set(made_for.missing) != set(own.missing):
        words = f"{len(own.missing)} missing places, those of {config.name}: this is a map of {made_for.name}"
        raise InputError(f"{path}: display.missing", f"{len(made_for.missing)} places", words)


def _build_map(path: Path, content: _PixelMapFile, config: Config) -> PixelMap:
    pixels, count = content.map.pixels, len(build_pixel_layout(config.display))
    if [pixel.index for pixel in pixels] != list(range(count)):
        raise InputError(
            f"{path}: map.pixels", f"{len(pixels)} entries", f"one for each pixel, 0 to {count - 1} in order"
        )
    numbers = {
        name: np.array([np.nan if (value := getattr(pixel, name)) is None else value for pixel in pixels])
        for name in NUMERIC_FIELDS
    }
    for axis, most_m in zip("xy", max_aim_offset_m(config), strict=True):
        far = np.abs(numbers[f"offset_{axis}_m"])
        if far.max() > most_m:
            at, words = int(far.argmax()), f"at most {most_m:.6g} either way, the focus within the pixel's own cell"
            raise InputError(f"{path}: pixel {at}: offset_{axis}_m", float(numbers[f"offset_{axis}_m"][at]), words)
    state = np.array([pixel.state for pixel in pixels])
    if np.all(state == DEAD):
        raise InputError(f"{path}: map.pixels", "none but dead ones", "a pixel that lives")
    return PixelMap(**numbers, state=state, model=content.model.parameters)
