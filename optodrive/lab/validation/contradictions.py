"""Facts held against each other: what no fit is needed for, and what a number that fits by chance would hide."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

from optodrive.lab.validation.extended_outcomes import AMBIENT_K
from optodrive.physics.paper_facts import Fact
from optodrive.physics.terms.gas_membrane import ATMOSPHERE_PA

LEVEL = 2.0
"""Two routes to one quantity contradict each other from this ratio on; the facts are known to some 10 %."""
THIN = 0.5
"""A plate's linear formula holds for displacements below this share of its thickness."""
CLAMPED = 3.0 / 16.0
TEXT_S1 = 3.0 / 1280.0


@dataclass(frozen=True)
class Contradiction:
    """One assumption that the paper's own numbers refuse: what, and by which numbers."""

    key: str
    words: str
    ratio: float


def contradictions(facts: Mapping[str, Fact]) -> tuple[Contradiction, ...]:
    """Those of Text S1's assumptions that the facts refuse."""
    return tuple(item for item in (_constant_volume(facts), _plate(facts)) if item is not None)


def _constant_volume(facts: Mapping[str, Fact]) -> Contradiction | None:
    radius_m, height_m = facts["cavity_r"].value, facts["z_peak_w020"].value
    swollen = 0.5 * pi * radius_m**2 * height_m / facts["V_pixel"].value
    # No pressure at all is left for the membrane at this rise, so it is the least that the gas can have.
    room_k = AMBIENT_K * swollen
    felt_k = AMBIENT_K * facts["F_peak_w020"].value / (pi * radius_m**2 * ATMOSPHERE_PA)
    if room_k < LEVEL * felt_k:
        return None
    words = (
        f"the gas is not at constant volume on the whole aperture: a membrane at {height_m * 1e3:.3g} mm adds "
        f"{100 * swollen:.0f} % to the cavity's volume, for which the gas must be {room_k:.0f} K warmer at least, "
        f"and the blocked force, taken so, says {felt_k:.0f} K"
    )
    return Contradiction("constant_volume", words, room_k / felt_k)


def _plate(facts: Mapping[str, Fact]) -> Contradiction | None:
    bent = facts["z_peak_w020"].value / facts["membrane_h"].value
    if bent < LEVEL * THIN:
        return None
    words = (
        f"no plate formula holds: the membrane rises by {bent:.1f} times its thickness and stretches; even a clamped "
        f"plate's centre has 3/16, {CLAMPED / TEXT_S1:.0f} times Text S1's 3/1280"
    )
    return Contradiction("small_deflection", words, bent / THIN)
