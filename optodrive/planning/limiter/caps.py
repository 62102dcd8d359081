"""The caps of the limiter: the single statement of each cap's key, texts, unit, setting and kernel value.

A new cap needs a row and a field here, its setting in `LimitsSection` of `optodrive.device.config_sections` and its
computation in `cap_checks`. Messages, telemetry, page and budget derive from the table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from math import sqrt
from typing import NamedTuple


class CapScale(Enum):
    """How a setting maps to the value that the kernels use."""

    LINEAR = "linear"
    TEMPERATURE = "temperature"
    """Setting in °C; value: rise above the ambient temperature and above what unbounded terms add, K."""
    RMS = "rms"
    """Setting: root mean square; value: mean square."""

    def to_value(self, setting: float, base_c: float) -> float:
        """Return the kernels' value of a setting.

        base_c: temperature at which rises are zero
        """
        if self is CapScale.TEMPERATURE:
            return setting - base_c
        return setting**2 if self is CapScale.RMS else setting

    def to_setting(self, value: float, limit: float, setting: float) -> float:
        """Return a value in the unit of the setting.

        limit: the kernels' value of `setting`
        """
        if self is CapScale.TEMPERATURE:
            return setting - (limit - value)
        return sqrt(value) if self is CapScale.RMS else value


@dataclass(frozen=True)
class Cap:
    """One cap.

    key: name in plans, answers and telemetry; label: short name on the page; message: name in sentences
    unit: unit of the setting, as shown; setting: key in the configuration's section [limits]
    field: field of `CapValues`; scale: from setting to value
    is_gauged: whether its use accumulates, so that telemetry shows it; is_per_pixel: whether one pixel uses it
    """

    key: str
    label: str
    message: str
    unit: str
    setting: str
    field: str
    scale: CapScale = CapScale.LINEAR
    is_gauged: bool = True
    is_per_pixel: bool = True


CAPS = (
    Cap(
        key="absorber_temperature",
        label="absorber temperature",
        message="absorber temperature cap",
        unit="°C",
        setting="absorber_max_c",
        field="absorber_k",
        scale=CapScale.TEMPERATURE,
    ),
    Cap(
        key="wall_temperature",
        label="wall temperature",
        message="wall temperature cap",
        unit="°C",
        setting="wall_max_c",
        field="wall_k",
        scale=CapScale.TEMPERATURE,
    ),
    Cap(
        key="touch_temperature",
        label="touch surface",
        message="touch surface temperature cap",
        unit="°C",
        setting="touch_max_c",
        field="touch_k",
        scale=CapScale.TEMPERATURE,
    ),
    Cap(
        key="pulse_energy",
        label="energy of a pulse",
        message="pulse energy cap",
        unit="J",
        setting="pulse_energy_max_j",
        field="pulse_energy_j",
        is_gauged=False,
    ),
    Cap(
        # Same setting as pulse_energy: the bucket holds one pulse of the largest energy, and leaks.
        key="spot_energy",
        label="energy in one pixel",
        message="cap on the energy bucket of a pixel",
        unit="J",
        setting="pulse_energy_max_j",
        field="pulse_energy_j",
    ),
    Cap(
        key="pulse_width",
        label="width of a pulse",
        # Pulses with gaps below pulse_gap_min_s count as one, since otherwise 50 ms pulses in a row would be unlimited.
        message="width cap of pulses without a gap between them",
        unit="s",
        setting="pulse_width_max_s",
        field="pulse_width_s",
        is_gauged=False,
    ),
    Cap(
        key="pixel_mean_power",
        label="mean power, one pixel",
        message="pixel mean power cap",
        unit="W",
        setting="pixel_mean_power_max_w",
        field="pixel_mean_w",
    ),
    Cap(
        key="display_mean_power",
        label="mean power, display",
        message="display mean power cap",
        unit="W",
        setting="display_mean_power_max_w",
        field="display_mean_w",
        is_per_pixel=False,
    ),
    Cap(
        key="galvo_acceleration",
        label="mirrors",
        message="galvo acceleration cap",
        unit="rad/s²",
        setting="galvo_acceleration_rms_max_rad_per_s2",
        field="galvo_rad2_per_s4",
        scale=CapScale.RMS,
        is_per_pixel=False,
    ),
    Cap(
        # A cap and not a factor on targets: trimmed, refused and proven on the bytes by the code of every other cap.
        # Not a share per caller: light adds up.
        key="dim",
        label="dimmed power",
        message="dim cap",
        unit="of full power",
        setting="power_share",
        field="power_share",
        is_gauged=False,
        is_per_pixel=False,
    ),
)

CAPS_BY_KEY: Mapping[str, Cap] = {cap.key: cap for cap in CAPS}

NO_CAP = 0
# For kernels alone: plans and messages hold keys, so that a new cap may stand anywhere in the table.
CAP_NUMBERS: Mapping[str, int] = {cap.key: number for number, cap in enumerate(CAPS, start=1)}
"""Number of each cap in kernels."""
WRONG_ORDER = len(CAPS) + 1
"""Number in kernels of a pulse that starts before the end of the last one."""
REASONS = ("", *CAP_NUMBERS, "order")
"""Key of each number; "" for no cap."""


class CapValues(NamedTuple):
    """Values of all caps and their parameters for kernels, with temperatures as rises, infinite where a cap is absent.

    pulse_gap_s: gate-off time after which pulses on a pixel count separately
    pixel_window_s, display_window_s: lengths of the windows over which mean powers are taken
    power_share: largest power of a pulse as a share of the laser's
    """

    power_share: float
    absorber_k: float
    wall_k: float
    touch_k: float
    galvo_rad2_per_s4: float
    pulse_energy_j: float
    pulse_width_s: float
    pulse_gap_s: float
    pixel_mean_w: float
    pixel_window_s: float
    display_mean_w: float
    display_window_s: float
