"""A pattern: the middle row and column."""

import numpy as np

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import Config
from optodrive.planning.stimuli.pattern import Pattern, PatternParameter
from optodrive.planning.stimuli.pixel_lattice import Lattice


def build_cross(config: Config, where: str, height_m: float) -> FrameSequence:
    """Build one frame of a second.

    where: place for error messages; height_m: the parameter height_um in SI units
    """
    layout = Lattice.from_config(config).layout
    arms = (layout.row == layout.row.max() // 2) | (layout.column == layout.column.max() // 2)
    return FrameSequence((TactileFrame("cross", 0.0, 1.0, np.where(arms, height_m, 0.0)),))


HEIGHT = PatternParameter("height_um", "number", 50.0, "peak height", "µm", min=1.0, max=1000.0)
CROSS = Pattern("cross", "the middle row and column", (HEIGHT,), build_cross)
