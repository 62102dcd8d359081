"""Facts held against each other: what no fit is needed for, and what a number that fits by chance would hide."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

from optodrive.lab.validation.extended_outcomes import AMBIENT_K
from optodrive.physics.paper_facts import PaperFact
from optodrive.physics.terms.gas_membrane import ATMOSPHERE_PA

MIN_RATIO = 2.0
"""Two routes to one quantity contradict each other from this ratio on; the facts are known to some 10 %."""
MAX_LINEAR_DEFLECTION = 0.5
"""A plate's linear formula holds for displacements below this share of its thickness."""
CLAMPED_PLATE_FACTOR = 3.0 / 16.0
TEXT_S1_PLATE_FACTOR = 3.0 / 1280.0


@dataclass(frozen=True)
class Contradiction:
    """One assumption that the paper's own numbers refuse: what, and by which numbers."""

    key: str
    description: str
    ratio: float


def find_contradictions(facts: Mapping[str, PaperFact]) -> tuple[Contradiction, ...]:
    """Those of Text S1's assumptions that the facts refuse."""
    return tuple(item for item in (_check_constant_volume(facts), _check_plate(facts)) if item is not None)


def _check_constant_volume(facts: Mapping[str, PaperFact]) -> Contradiction | None:
    radius_m, height_m = facts["cavity_r"].value, facts["z_peak_w020"].value
    volume_increase = 0.5 * pi * radius_m**2 * height_m / facts["V_pixel"].value
    # No pressure at all is left for the membrane at this rise, so it is the least that the gas can have.
    volume_rise_k = AMBIENT_K * volume_increase
    force_rise_k = AMBIENT_K * facts["F_peak_w020"].value / (pi * radius_m**2 * ATMOSPHERE_PA)
    if volume_rise_k < MIN_RATIO * force_rise_k:
        return None
    description = (
        f"the gas is not at constant volume on the whole aperture: a membrane at {height_m * 1e3:.3g} mm adds "
        f"{100 * volume_increase:.0f} % to the cavity's volume, for which the gas must be {volume_rise_k:.0f} K warmer at least, "
        f"and the blocked force, taken so, says {force_rise_k:.0f} K"
    )
    return Contradiction("constant_volume", description, volume_rise_k / force_rise_k)


def _check_plate(facts: Mapping[str, PaperFact]) -> Contradiction | None:
    relative_deflection = facts["z_peak_w020"].value / facts["membrane_h"].value
    if relative_deflection < MIN_RATIO * MAX_LINEAR_DEFLECTION:
        return None
    description = (
        f"no plate formula holds: the membrane rises by {relative_deflection:.1f} times its thickness and stretches; even a clamped "
        f"plate's centre has 3/16, {CLAMPED_PLATE_FACTOR / TEXT_S1_PLATE_FACTOR:.0f} times Text S1's 3/1280"
    )
    return Contradiction("small_deflection", description, relative_deflection / MAX_LINEAR_DEFLECTION)
