"""Findings become tables that a model file may hold, or are named as not to be planned with."""

import numpy as np
import pytest

from optodrive.lab.discovery import Curve
from optodrive.lab.inference.claim import Claim, TermClaim, TermForm
from optodrive.lab.pixel_discovery.findings import PixelDiscovery, PixelFinding
from optodrive.lab.pixel_discovery.planned_terms import build_planned_terms

PARAMETERS = {"R": 184.0, "C": 126e-6, "tau_g": 3e-3, "kappa": 4e-6, "phi": 2.3e-4, "tau_m": 0.03}


def plan_with(where, depends_on, function, low, high, kind=""):
    x = np.linspace(low, high, 20)
    curve = Curve(x, function(x), function(x), function(x), function)
    form = TermForm(where, depends_on, kind, "f", 1.0, 1.0)
    finding = PixelFinding("absorber", TermClaim(Claim("cause"), 1.0, (form,), form, ()), curve)
    return build_planned_terms(PixelDiscovery((finding,), (), Claim("cause"), "", 2.0, 1.0, PARAMETERS, 0.0))


@pytest.mark.parametrize("quantity", ["memory", "gas"])
def test_a_cold_memory_does_not_heat(quantity):
    (term,) = plan_with("dabsorber/dt", (quantity,), lambda z: -5.0 * z, -3.0, 80.0).terms
    assert (term.low, term.high, max(term.values)) == (0.0, 80.0, 0.0)


def test_light_is_never_below_darkness():
    (term,) = plan_with("dabsorber/dt", ("absorber", "light"), lambda z: -100.0 * z, 0.0, 100.0).terms
    assert (term.where, min(term.values)) == ("light", -1.0)


def test_what_is_nothing_beside_the_term_is_taken_from_it():
    (term,) = plan_with("dabsorber/dt", ("absorber",), lambda z: 1e-5 - 1.0 * z, -20.0, 100.0).terms
    assert abs(np.interp(0.0, np.linspace(term.low, term.high, 65), term.values)) < 1e-12


def test_a_plan_simulates_no_hysteresis():
    planned = plan_with("displacement", ("gas",), lambda z: 1e-6 * z, -1.0, 1.0, kind="hysteresis")
    assert (planned.terms, planned.refused) == ((), ("f depends on the past, which a plan does not simulate",))


@pytest.mark.parametrize(
    ("where", "depends_on", "function", "reason"),
    [
        ("displacement", ("light",), lambda z: 1e-6 * z, "depends_on: got 'light'"),
        ("dabsorber/dt", ("absorber", "heating"), lambda z: -0.02 * z, "-0.9 to 10"),
        ("dabsorber/dt", ("absorber",), lambda z: -1e6 * z, "-10 to 10 W"),
    ],
)
def test_what_a_file_may_not_hold_is_a_reason_and_no_error(where, depends_on, function, reason):
    planned = plan_with(where, depends_on, function, 0.0, 100.0)
    assert not planned.terms
    assert reason in planned.refused[0]
