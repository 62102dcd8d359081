"""Terms as readable formulas, and candidates as terms."""

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.discovery.fitting import Terms
from optodrive.lab.discovery.forms import BUMP, COSINE, DECAY, EXPONENTIAL, POWER, SATURATION, SINE, Form
from optodrive.lab.discovery.screening import Candidate

SMOOTHING = {SATURATION: 2e-3, EXPONENTIAL: 1e-2, BUMP: 1e-2, DECAY: 1e-4}
"""Smallest inner number that is a scale, relative to the variable's largest value."""


def build_terms(candidate: Candidate, nodes: FloatArray) -> Terms:
    """Return a candidate as a row of a table of terms, with limits of the inner numbers from the variable's nodes."""
    at, form, first = candidate.at, candidate.form, candidate.first
    size, span = float(np.abs(nodes).max()), float(nodes[-1] - nodes[0])
    edge = SMOOTHING.get(form.code, 0.0) * size
    if form.code == SATURATION:
        limits = (edge, 5.0 * size)
    elif form.code == EXPONENTIAL:
        limits = (edge, np.inf) if first > 0.0 else (-np.inf, -edge)
    elif form.code in (SINE, COSINE):
        limits = (0.3 * first, 3.0 * first)
    elif form.code == DECAY:
        limits = (edge, 10.0 * size)
    else:
        limits = (float(nodes[0]) - 0.5 * span, float(nodes[-1]) + 0.5 * span)
    return Terms(
        np.array([[at.place, form.code, at.variable, at.factor]]),
        np.array([[candidate.amplitude, first, candidate.second]]),
        np.array([[True, form.free > 0, form.free > 1]]),
        np.array([[-np.inf, limits[0], 0.01 * span]]),
        np.array([[np.inf, limits[1], 10.0 * span]]),
    )


def format_number(value: float) -> str:
    """Return a number with four significant digits."""
    return f"{value:.4g}"


def describe_term(form: Form, values: FloatArray, variable: str, factor: str = "") -> str:
    """Return one term, such as -7.41e+05 x^3."""
    text = form.text.format(z=variable, a=format_number(values[1]), b=format_number(values[2]))
    if form.code == POWER and values[1] == 1.0:
        text = variable
    if form.code == SATURATION and "tanh" not in form.text:
        text = f"sign({variable})"
    return " ".join(part for part in (format_number(values[0]), factor, text) if part)
