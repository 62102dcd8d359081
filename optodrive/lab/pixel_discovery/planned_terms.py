"""Functions that heights are planned with, from the findings of a discovery."""

from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from optodrive.core.toml_model import build_input_error
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.prediction import EPSILON
from optodrive.lab.discovery import Curve
from optodrive.lab.discovery.memory import KINDS
from optodrive.lab.pixel_discovery.findings import PixelDiscovery, PixelFinding
from optodrive.lab.pixel_discovery.pixel_model import AFTER, LIGHT
from optodrive.physics.discovered_term import KNOTS, UNITS, DiscoveredTerm

RATE_OF_ABSORBER, RATE_OF_GAS = "dabsorber/dt", "dgas/dt"
NEGLIGIBLE = 1e-6
BASE = ("R", "C", "tau_g", "kappa", "phi")


@dataclass(frozen=True, eq=False)
class PlannedTerms:
    """The extended pixel for planning.

    base: parameters of the pixel, SI; terms: functions to be added; refused: why a finding cannot be planned with, by
    finding; heights are then not better than those of the nominal pixel
    """

    base: dict[str, float]
    terms: tuple[DiscoveredTerm, ...]
    refused: tuple[str, ...]


def build_planned_terms(discovery: PixelDiscovery) -> PlannedTerms:
    """Return the terms of all findings that act in the pixel.

    What an instrument adds to its reading changes no height and is left out.
    """
    base = {name: discovery.parameters[name] for name in BASE if name in discovery.parameters}
    terms, refused = list[DiscoveredTerm](), list[str]()
    for finding in discovery.findings:
        if finding.node == "sensor":
            continue
        if finding.curve is None:
            refused.append("the light changes at random, otherwise in every run")
        elif AFTER in finding.term.chosen.depends_on:
            refused.append("light after the gate has closed has no bound in the limiter")
        elif finding.term.chosen.kind in KINDS:
            refused.append(f"{finding.term.chosen.formula} depends on the past, which a plan does not simulate")
        elif _acts_when_cold(finding, finding.curve):
            refused.append(f"{finding.term.chosen.formula} acts on a pixel without light")
        else:
            try:
                terms.append(_build_term(finding, finding.curve, discovery))
            except ValidationError as error:
                refused.append(str(build_input_error(error, finding.term.chosen.formula)))
    return PlannedTerms(base, tuple(terms), tuple(refused))


def _acts_when_cold(finding: PixelFinding, curve: Curve) -> bool:
    """Return whether a term without a factor differs from 0 on a cold pixel in the dark."""
    z = _choose_knots(float(curve.x[0]), float(curve.x[-1]))
    at_zero = float(curve.evaluate(np.clip(np.zeros(1), z[0], z[-1]))[0])
    return len(finding.term.chosen.depends_on) == 1 and abs(at_zero) > NEGLIGIBLE * float(
        np.abs(curve.evaluate(z)).max()
    )


def _build_term(finding: PixelFinding, curve: Curve, discovery: PixelDiscovery) -> DiscoveredTerm:
    """Return the function of one finding.

    Rates of the absorber become heat flows by its capacity, absorbed light becomes incident light.
    """
    form, parameters = finding.term.chosen, discovery.parameters
    variable, *factor = form.depends_on
    where, depends_on, low = form.where, variable, float(curve.x[0])
    if where == RATE_OF_ABSORBER and depends_on in ("memory", "gas"):
        low = max(0.0, low)  # its cold would heat, and there is hardly a record of it
    z = _choose_knots(low, float(curve.x[-1]))
    low, high, values = float(z[0]), float(z[-1]), curve.evaluate(z)
    if not factor:  # by less than is negligible, see `_acts_when_cold`
        values = values - float(np.interp(0.0, z, values))
    if form.where == RATE_OF_GAS:
        where = "gas"
    elif form.where == RATE_OF_ABSORBER:
        where, capacity = "absorber", parameters["C"]
        if factor == ["heating"]:
            where, capacity = "heat_capacity", 1.0
        elif factor == [LIGHT]:
            where = "light"
        elif variable == LIGHT:
            where, depends_on, low, high, capacity = "light", "power", low / EPSILON, high / EPSILON, capacity / EPSILON
        values = values * capacity
    if where == "light" and depends_on != "power":
        values = np.maximum(values, -1.0)  # darkness
    return DiscoveredTerm.model_validate(
        {
            "where": where,
            "depends_on": depends_on,
            "unit": "W" if depends_on == "power" else UNITS[where],
            "formula": f"{form.where}: {form.formula}",
            "low": low,
            "high": high,
            "values": values.tolist(),
            "memory_time_s": parameters["tau_m"] if depends_on == "memory" else None,
            "max_power_w": discovery.max_power_w or None,
            "source": "a discovery",
        }
    )


def _choose_knots(low: float, high: float) -> FloatArray:
    """Return the knots [65] of a function over a range, one of them at 0 if it lies within, as does many a kink."""
    if not low < 0.0 < high:
        return np.linspace(low, high, KNOTS)
    distance = (high - low) / (KNOTS - 2)
    return np.asarray(distance * (np.arange(KNOTS) - np.ceil(-low / distance)))
