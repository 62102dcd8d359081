"""Measured facts of the paper with their errors, and the reasons for excluding the others."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

from optodrive.physics.paper_facts import AMBIENT_C, PaperFact
from optodrive.physics.parameters import ParameterSet

READING_ERROR = 0.05
"""Relative error of a value read from a figure or rounded in the text, where the paper states none."""

GROUPS = {
    "temperatures": ("dT_peak_w020", "T_peak_w075"),
    "displacements": ("z_peak_w020", "z_peak_w075", "z_tp8_w040"),
    "forces": ("F_peak_w020", "F_peak_w055"),
    "rates": ("N_50um", "N_400um"),
    "vibration": ("dpp_200Hz", "dpp_law", "slow_law"),
}
"""Measured facts by measurement."""

MEASURED_IDS = tuple(name for group in GROUPS.values() for name in group)

LAW_R2 = {"dpp_law": 0.95, "slow_law": 0.81}
"""r² of two facts that are a law at one point (Fig. 3D); √(1 − r²) is taken as their relative error."""

RATE_HEIGHTS_M = {"N_50um": 50e-6, "N_400um": 400e-6}
"""Heights of the rates; rates are compared by the height reached per pixel, because they saturate near the plateau."""

EXCLUDED = {
    "T_peak_w020": "the same reading as dT_peak_w020",
    "z_repeat_w040": "an upper bound that every model here satisfies",
    "F_linear_in_P": "a statement without a value",
    "dT_air_isometric": "inferred from F_peak_w020, not measured",
    "dQ_air": "inferred from F_peak_w020, not measured",
    "eta_stroke": "arithmetic of F_peak_w020 and z_peak_w020",
    "eta_qt": "arithmetic of dQ_air",
    "eta_tm": "arithmetic of eta_stroke and eta_qt",
}
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
