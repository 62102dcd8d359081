"""The panel of a display, completed by estimates from its size and materials, and neighbours of its pixels."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import IntArray, ReadOnlyArrays
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.config_sections import DisplaySection

RIM_M = 0.01
"""Width of the rim around the pixels."""
LOSS_W_PER_M2_K = 20.0
"""Heat that a panel loses on both faces together: convection of still air and radiation, 10 W/(m² K) on each."""
CAPACITY_J_PER_M2_K = 3700.0
"""Heat capacity of 2.1 mm of acrylic and polystyrene at 1.75 MJ/(m³ K), Table S4."""


class Panel(NamedTuple):
    """Size, thermal resistance to the room and heat capacity, with all walls, of a panel."""

    width_m: float
    height_m: float
    resistance_k_per_w: float
    capacity_j_per_k: float


def complete_panel(config: Config) -> Panel:
    """Return the panel of a configuration. Values that it does not state are estimated."""
    display, panel = config.display, config.panel
    width_m = panel.width_m or display.columns * display.pitch_m + 2 * RIM_M
    height_m = panel.height_m or display.rows * display.pitch_m + 2 * RIM_M
    area_m2 = width_m * height_m
    return Panel(
        width_m,
        height_m,
        panel.resistance_k_per_w or 1.0 / (LOSS_W_PER_M2_K * area_m2),
        panel.capacity_j_per_k or CAPACITY_J_PER_M2_K * area_m2,
    )


@dataclass(frozen=True, eq=False)
class Neighbours(ReadOnlyArrays):
    """Pixels that share an edge with each pixel.

    indices: [p, 4] left, right, below and above, −1 for none; frame_edges: [p] number of edges on the frame, at the rim
    of the lattice. No heat crosses the edge to a missing place.
    """

    indices: IntArray
    frame_edges: IntArray

    def __len__(self) -> int:
        return len(self.frame_edges)

    @classmethod
    def from_display(cls, display: DisplaySection) -> "Neighbours":
        """Return the neighbours on a display's lattice."""
        layout = build_pixel_layout(display)
        # A rim of −1 around the lattice: no edge is a special case below.
        index = np.full((display.rows + 2, display.columns + 2), -1, dtype=np.int64)
        index[layout.row + 1, layout.column + 1] = np.arange(len(layout))
        row, column = layout.row + 1, layout.column + 1
        indices = np.stack(
            [index[row, column - 1], index[row, column + 1], index[row - 1, column], index[row + 1, column]], axis=1
        )
        at_rim = [layout.column == 0, layout.column == display.columns - 1]
        at_rim += [layout.row == 0, layout.row == display.rows - 1]
        return cls(indices, np.sum(at_rim, axis=0).astype(np.int64))
