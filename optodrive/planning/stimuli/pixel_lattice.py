"""Lattice of a display, which maps a place (row, column from the bottom left) to a pixel index."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import IntArray, freeze_arrays
from optodrive.device.config import Config, PixelLayout, build_pixel_layout


@dataclass(frozen=True, eq=False)
class Lattice:
    """Places of a display's lattice.

    index: [rows, columns] pixel at a place, -1 if there is none; layout: the inverse, [p].
    """

    name: str
    index: IntArray
    layout: PixelLayout

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @classmethod
    def from_config(cls, config: Config) -> "Lattice":
        """Build the lattice of a configured display."""
        layout, shape = build_pixel_layout(config.display), (config.display.rows, config.display.columns)
        return cls(config.name, _index_places(layout, shape), layout)

    @classmethod
    def from_layout(cls, name: str, layout: PixelLayout) -> "Lattice":
        """Build the lattice of a layout, up to its last row and column."""
        return cls(name, _index_places(layout, (int(layout.row.max()) + 1, int(layout.column.max()) + 1)), layout)

    def pixel_at(self, row: int, column: int) -> int | None:
        """Return the pixel at a place, or None if there is none."""
        rows, columns = self.index.shape
        if not (0 <= row < rows and 0 <= column < columns):
            return None
        pixel = int(self.index[row, column])
        return pixel if pixel >= 0 else None

    def middle_pixel(self) -> int:
        """Return the pixel nearest to the display's middle, the lowest index among equals."""
        distance_m = np.round(np.hypot(self.layout.x_m, self.layout.y_m), 9)
        return int(np.argmin(distance_m))

    def pixels_around(
        self, centre: int | None, offsets: Iterable[tuple[int, int]], where: str, requirement: str
    ) -> list[int]:
        """Return the pixels at offsets (rows up, columns right) from a centre. None is the middle pixel.

        requirement: what must surround the centre, for the message. Raises InputError (does_not_fit).
        """
        centre = self.middle_pixel() if centre is None else centre
        row, column = int(self.layout.row[centre]), int(self.layout.column[centre])
        pixels = []
        for up, right in offsets:
            pixel = self.pixel_at(row + up, column + right)
            if pixel is None:
                rows, columns = self.index.shape
                raise InputError(
                    f"{where}: centre",
                    centre,
                    f"a pixel with {requirement} ({self.name} is {rows} × {columns})",
                    code="does_not_fit",
                )
            pixels.append(pixel)
        return pixels


def _index_places(layout: PixelLayout, shape: tuple[int, int]) -> IntArray:
    index = np.full(shape, -1, dtype=np.int64)
    index[layout.row, layout.column] = np.arange(len(layout))
    return index
