"""Sensitivity map, the file sensitivity.toml: how sensitive one person is at every pixel of a display."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field as Item

from optodrive.core.errors import InputError
from optodrive.core.files import write_text
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.pixel_map import BYTES_MAX, MappedDisplay, check_mapped_display, format_map_head, read_change

FORMAT = "optodrive-sensitivity"
VERSION = 1
SENSITIVITY_MIN, SENSITIVITY_MAX = 0.1, 10.0
"""Range of plausible sensitivities."""
PARTICIPANT_MAX = 40
"""Largest length of a person's code, characters."""


class _Pixel(Section):
    index: Annotated[int, Item(ge=0)]
    sensitivity: Annotated[float, Item(ge=SENSITIVITY_MIN, le=SENSITIVITY_MAX)]
    sensitivity_sigma: Annotated[float, Item(ge=0)]


class _Map(Section):
    participant: Annotated[str, Item(pattern=r"^[A-Za-z0-9]+$", max_length=PARTICIPANT_MAX)]
    trials: Annotated[int, Item(ge=1)]
    pixels: tuple[_Pixel, ...]


class _SensitivityFile(Section):
    format: str
    version: int
    about: dict[str, str | float | int] = Item(default_factory=dict)
    display: MappedDisplay
    map: _Map


@dataclass(frozen=True, eq=False)
class SensitivityMap:
    """Sensitivity of a person at every pixel, both arrays [p].

    sensitivity: felt amplitude over that of the channel model; its mean in the logarithm is 0, because matching
    compares places; sigma: its standard uncertainty; participant: code; trials: on which it rests
    """

    sensitivity: FloatArray
    sigma: FloatArray
    participant: str
    trials: int

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.sensitivity)


def replace_sensitivity_map(config: Config, path: Path | None) -> Config:
    """Return the configuration with another sensitivity map file, or with none."""
    display = config.display.model_copy(update={"sensitivity_map": None if path is None else str(path)})
    return config.model_copy(update={"display": display})


def load_sensitivity_map(config: Config) -> SensitivityMap | None:
    """Load the sensitivity map that a configuration names and check it against the display. None if it names none."""
    if config.display.sensitivity_map is None:
        return None
    path = Path(config.display.sensitivity_map)
    content = _read_file(path, *read_change(path))
    check_mapped_display(path, content.display, config)
    pixels, count = content.map.pixels, len(build_pixel_layout(config.display))
    if [pixel.index for pixel in pixels] != list(range(count)):
        expected = f"one entry per pixel, 0 to {count - 1} in order"
        raise InputError(f"{path}: map.pixels", f"{len(pixels)} entries", expected)
    sensitivity = np.array([pixel.sensitivity for pixel in pixels])
    sigma = np.array([pixel.sensitivity_sigma for pixel in pixels])
    return SensitivityMap(sensitivity, sigma, content.map.participant, content.map.trials)


def write_sensitivity_map(
    path: Path, sensitivity_map: SensitivityMap, config: Config, about: dict[str, str | float | int]
) -> None:
    """Write sensitivity.toml atomically.

    about: informative entries, text without quotes or backslashes
    """
    lines = [f'format = "{FORMAT}"', f"version = {VERSION}", "", *format_map_head(config, about)]
    lines += ["", "[map]", f'participant = "{sensitivity_map.participant}"', f"trials = {sensitivity_map.trials}"]
    lines += ["pixels = ["]
    for index, (value, sigma) in enumerate(zip(sensitivity_map.sensitivity, sensitivity_map.sigma, strict=True)):
        lines += [f"  {{ index = {index}, sensitivity = {value:.5g}, sensitivity_sigma = {sigma:.3g} }},"]
    write_text(path, "\n".join([*lines, "]"]) + "\n")


@lru_cache(maxsize=8)
def _read_file(path: Path, _changed_ns: int, _size: int) -> _SensitivityFile:
    table = read_toml(path, BYTES_MAX)
    check_format(path, table, FORMAT, VERSION)
    return parse_table(path, table, _SensitivityFile)
