"""Measured facts of the paper, their errors, the reasons to exclude others, and assumptions that they contradict."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi, sqrt

from optodrive.core.quantity import format_quantity
from optodrive.lab.validation.stimuli import AMBIENT_K
from optodrive.physics.paper_facts import AMBIENT_C, PaperFact, list_stated
from optodrive.physics.parameters import ParameterSet
from optodrive.physics.terms.mechanical import ATMOSPHERE_PA

READING_ERROR = 0.05
"""Relative error of a value read from a figure or rounded in the text, where the paper states none."""

_GROUP_OF = list_stated("group")
GROUPS = {
    group: tuple(name for name, own in _GROUP_OF.items() if own == group) for group in dict.fromkeys(_GROUP_OF.values())
}
"""Measured facts by measurement."""

MEASURED_IDS = tuple(name for group in GROUPS.values() for name in group)

LAW_R2 = {"dpp_law": 0.95, "slow_law": 0.81}
"""r² of two facts that are a law at one point (Fig. 3D); √(1 − r²) is taken as their relative error."""

RATE_HEIGHTS_M = {"N_50um": 50e-6, "N_400um": 400e-6}
"""Heights of the rates; rates are compared by the height reached per pixel, because they saturate near the plateau."""

EXCLUDED = list_stated("excluded")
"""Outcomes that are no independent measurements."""


@dataclass(frozen=True)
class Datum:
    """Measured value in SI (temperatures as rises, K) with its relative standard errors.

    reading_error: of the value itself, with its source; scatter: between samples, which no model of one pixel predicts
    """

    id: str
    group: str
    value: float
    reading_error: float
    scatter: float
    source: str

    @property
    def sigma(self) -> float:
        """Standard error of the logarithm."""
        return sqrt(self.reading_error**2 + self.scatter**2)


def compute_scatter(parameters: ParameterSet) -> float:
    """Return the relative scatter between samples, which no model of one pixel predicts.

    It is the geometric mean of the scatters of R w and of C in Table S3: a fact depends on either according to its
    pulse.
    """
    shares = [(item.sigma or 0.0) / item.value for item in (parameters.R_width_product, parameters.C_mean)]
    return sqrt(shares[0] * shares[1])


def build_measured_facts(facts: Mapping[str, PaperFact], parameters: ParameterSet) -> tuple[Datum, ...]:
    """Return the measured facts in the order of GROUPS."""
    scatter = compute_scatter(parameters)
    return tuple(_build_datum(facts[name], group, scatter) for group, names in GROUPS.items() for name in names)


def _build_datum(fact: PaperFact, group: str, scatter: float) -> Datum:
    value = fact.value - (AMBIENT_C if fact.unit == "°C" else 0.0)
    if fact.id in LAW_R2:
        return Datum(fact.id, group, value, sqrt(1.0 - LAW_R2[fact.id]), scatter, f"r² = {LAW_R2[fact.id]:g}")
    if fact.uncertainty is not None:
        return Datum(fact.id, group, value, fact.uncertainty / value, scatter, "stated")
    return Datum(fact.id, group, value, READING_ERROR, scatter, "assumed")


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
