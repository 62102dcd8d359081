"""The panel of a display: its configuration, completed by estimates from its size and materials."""

from typing import NamedTuple

from optodrive.device.config import Config

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
