"""The effective configuration: the configuration with everything that is derived from it."""

from typing import TYPE_CHECKING

from optodrive.core.toml_model import Section
from optodrive.device.config import Config
from optodrive.device.config_sections import (
    DisplaySection,
    LimitsSection,
    PanelSection,
    PixelModelSection,
    ScannerSection,
)
from optodrive.device.panel import complete_panel
from optodrive.planning.limiter.caps import CAPS

if TYPE_CHECKING:
    from optodrive.planning.display_model import DisplayModel

UNITS = {"R": "K/W", "C": "J/K", "epsilon": "1", "tau_g": "s", "kappa": "m/K", "phi": "N/K"}


class PixelPlace(Section):
    """The position of one pixel on the display, and the width of its bridges.

    index: of the pixel
    x_m, y_m: centre on the display, from its middle, m
    bridge_width_m: width of its bridges, m
    """

    index: int
    x_m: float
    y_m: float
    bridge_width_m: float


class EffectiveDisplay(DisplaySection):
    """The section [display] and its pixels, by index.

    pixels: places of all pixels, by index
    """

    pixels: tuple[PixelPlace, ...]


class CapDescription(Section):
    """A cap as shown to people: its label, its unit and its setting in the section [limits].

    label: of the cap for people
    unit: of the cap
    setting: its key in the section [limits]
    """

    label: str
    unit: str
    setting: str


class EffectiveLimits(LimitsSection):
    """The section [limits] and descriptions of its caps, by the key that plans and telemetry use.

    caps: by the name that plans and telemetry use
    """

    caps: dict[str, CapDescription]


class EffectiveScanner(ScannerSection):
    """The section [scanner] and the settling time of a move by one pitch, after a long dwell.

    settling_pitch_s: settling time of a move by one pitch, s
    """

    settling_pitch_s: float


class EffectivePanel(PanelSection):
    """The section [panel], with an estimate for each value that it does not state."""

    width_m: float
    height_m: float
    resistance_k_per_w: float
    capacity_j_per_k: float


class EffectivePixelModel(PixelModelSection):
    """The section [pixel_model] and the parameters of a pixel. `planner_terms` holds the parameters of each term.

    R: thermal resistance from the absorber to the wall, K/W
    C: heat capacity of the absorber and its gas, J/K
    epsilon: absorbed share of the light
    tau_g: time constant between absorber and gas, s
    kappa: rise of the membrane per kelvin, m/K
    phi: force per kelvin, N/K
    planner_terms: parameters of each term that plans take into account, by its key
    units: of the pixel's parameters
    """

    R: float
    C: float
    epsilon: float
    tau_g: float
    kappa: float
    phi: float
    planner_terms: dict[str, dict[str, float]]
    units: dict[str, str]


class EffectiveConfig(Config):
    """The configuration as `optodrive config show --json` prints it and GET /v1/config sends it."""

    display: EffectiveDisplay
    limits: EffectiveLimits
    scanner: EffectiveScanner
    pixel_model: EffectivePixelModel
    panel: EffectivePanel


def build_effective_config(display: "DisplayModel") -> EffectiveConfig:
    """Add pixel positions, the settling time of one pitch, and the pixel model's parameters to a configuration."""
    config, layout = display.config, display.layout
    settling = display.scan_head.settling
    settling_us = settling.settling_us(settling.pitch_rad, settling.pitch_rad, settling.long_dwell_us)
    pixel = display.parameters.build_pixel(config.display.bridge_width_m)
    places = [
        PixelPlace(index=index, x_m=x_m, y_m=y_m, bridge_width_m=config.display.bridge_width_m)
        for index, (x_m, y_m) in enumerate(zip(layout.x_m.tolist(), layout.y_m.tolist(), strict=True))
    ]
    caps = {cap.key: CapDescription(label=cap.label, unit=cap.unit, setting=cap.setting) for cap in CAPS}
    return EffectiveConfig.model_validate(
        dict(config)
        | {
            "display": dict(config.display) | {"pixels": places},
            "panel": complete_panel(config)._asdict(),
            "limits": dict(config.limits) | {"caps": caps},
            "scanner": dict(config.scanner) | {"settling_pitch_s": settling_us * 1e-6},
            "pixel_model": {
                **dict(config.pixel_model),
                "R": pixel.r_k_per_w,
                "C": pixel.c_j_per_k,
                "epsilon": pixel.epsilon,
                "tau_g": pixel.tau_g_s,
                "kappa": pixel.kappa_m_per_k,
                "phi": pixel.phi_n_per_k,
                "planner_terms": {key: display.parameters.term_values(key) for key in display.parameters.planner_terms},
                "units": UNITS,
            },
        }
    )
