"""Contradictions between the paper's own facts and the assumptions of Text S1, independent of any fit."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

from optodrive.core.quantity import format_quantity
from optodrive.lab.validation.extended_outcomes import AMBIENT_K
from optodrive.physics.paper_facts import PaperFact
from optodrive.physics.terms.gas_membrane import ATMOSPHERE_PA

MIN_RATIO = 2.0
"""Ratio of two estimates of one quantity from which they contradict each other; the facts are known to some 10 %."""
MAX_LINEAR_DEFLECTION = 0.5
"""Displacement, in plate thicknesses, below which the linear plate formula holds."""
CLAMPED_PLATE_FACTOR = 3.0 / 16.0
TEXT_S1_PLATE_FACTOR = 3.0 / 1280.0


@dataclass(frozen=True)
class Contradiction:
    """Assumption that the paper's own values contradict."""

    key: str
    description: str
    ratio: float


def find_contradictions(facts: Mapping[str, PaperFact]) -> tuple[Contradiction, ...]:
    """Return the assumptions of Text S1 that the facts contradict."""
    return tuple(item for item in (_check_constant_volume(facts), _check_plate(facts)) if item is not None)


def _check_constant_volume(facts: Mapping[str, PaperFact]) -> Contradiction | None:
    radius_m, height_m = facts["cavity_r"].value, facts["z_peak_w020"].value
    volume_increase = 0.5 * pi * radius_m**2 * height_m / facts["V_pixel"].value
    # A lower bound of the gas temperature rise: it leaves no pressure to stretch the membrane.
    volume_rise_k = AMBIENT_K * volume_increase
    force_rise_k = AMBIENT_K * facts["F_peak_w020"].value / (pi * radius_m**2 * ATMOSPHERE_PA)
    if volume_rise_k < MIN_RATIO * force_rise_k:
        return None
    description = (
        f"the gas is not at constant volume on the whole aperture: a membrane at {format_quantity(height_m, 'm')} adds "
        f"{100 * volume_increase:.0f} % to the cavity's volume, which requires a gas rise of at least "
        f"{volume_rise_k:.0f} K, but the blocked force implies {force_rise_k:.0f} K"
    )
    return Contradiction("constant_volume", description, volume_rise_k / force_rise_k)


def _check_plate(facts: Mapping[str, PaperFact]) -> Contradiction | None:
    relative_deflection = facts["z_peak_w020"].value / facts["membrane_h"].value
    if relative_deflection < MIN_RATIO * MAX_LINEAR_DEFLECTION:
        return None
    description = (
        f"no plate formula holds: the membrane rises by {relative_deflection:.1f} times its thickness and stretches; "
        f"even the constant of a clamped plate is 3/16, {CLAMPED_PLATE_FACTOR / TEXT_S1_PLATE_FACTOR:.0f} times 3/1280 "
        "of Text S1"
    )
    return Contradiction("small_deflection", description, relative_deflection / MAX_LINEAR_DEFLECTION)
