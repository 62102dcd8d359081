"""Sensitivity map, the file sensitivity.toml: how sensitive one person is at every pixel of a display."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field as Item

from optodrive.core.files import write_text
from optodrive.core.types.arrays import FloatArray, ReadOnlyArrays
from optodrive.device.config import Config
from optodrive.device.pixel_map import VERSION, MapFile, MappedPixel, MappedPixels, format_map_head, read_map_file

FORMAT = "optodrive-sensitivity"
SENSITIVITY_MIN, SENSITIVITY_MAX = 0.1, 10.0
"""Range of plausible sensitivities."""
PARTICIPANT_MAX = 40
"""Largest length of a person's code, characters."""


class _Pixel(MappedPixel):
    sensitivity: Annotated[float, Item(ge=SENSITIVITY_MIN, le=SENSITIVITY_MAX)]
    sensitivity_sigma: Annotated[float, Item(ge=0)]


class _Map(MappedPixels):
    participant: Annotated[str, Item(pattern=r"^[A-Za-z0-9]+$", max_length=PARTICIPANT_MAX)]
    trials: Annotated[int, Item(ge=1)]
    pixels: tuple[_Pixel, ...]


class _SensitivityFile(MapFile):
    map: _Map


@dataclass(frozen=True, eq=False)
class SensitivityMap(ReadOnlyArrays):
    """Sensitivity of a person at every pixel, both arrays [p].

    sensitivity: felt amplitude over that of the channel model; its mean in the logarithm is 0, because matching
    compares places; sigma: its standard uncertainty; participant: code; trials: on which it rests
    """

    sensitivity: FloatArray
    sigma: FloatArray
    participant: str
    trials: int

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
    content = read_map_file(Path(config.display.sensitivity_map), _SensitivityFile, FORMAT, config)
    sensitivity = np.array([pixel.sensitivity for pixel in content.map.pixels])
    sigma = np.array([pixel.sensitivity_sigma for pixel in content.map.pixels])
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
