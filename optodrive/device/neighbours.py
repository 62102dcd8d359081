"""Neighbour relations on the lattice of pixels."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import IntArray, freeze_arrays
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_sections import DisplaySection


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Pixels that share an edge with each pixel.

    indices: [p, 4] left, right, below and above, −1 for none; frame_edges: [p] number of edges on the frame, at the rim
    of the lattice. No heat crosses the edge to a missing place.
    """

    indices: IntArray
    frame_edges: IntArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.frame_edges)

    @classmethod
    def from_display(cls, display: DisplaySection) -> "Neighbours":
        """Return the neighbours on a display's lattice."""
        layout = build_pixel_layout(display)
        index = np.full((display.rows + 2, display.columns + 2), -1, dtype=np.int64)
        index[layout.row + 1, layout.column + 1] = np.arange(len(layout))
        row, column = layout.row + 1, layout.column + 1
        indices = np.stack(
            [index[row, column - 1], index[row, column + 1], index[row - 1, column], index[row + 1, column]], axis=1
        )
        at_rim = [layout.column == 0, layout.column == display.columns - 1]
        at_rim += [layout.row == 0, layout.row == display.rows - 1]
        return cls(indices, np.sum(at_rim, axis=0).astype(np.int64))
