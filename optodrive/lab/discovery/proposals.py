"""Proposed formulas of a term with all numbers fitted, and the choice of the simplest that does as well as the best."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.discovery.fitting import Point
from optodrive.lab.discovery.forms import Form
from optodrive.lab.discovery.formula_text import describe_term
from optodrive.lab.discovery.model import Curve, Finding, OdeModel
from optodrive.lab.discovery.screening import Candidate, Filtered, Place, Screened, screen

TOLERANCE, SHARE_TOLERANCE = 0.06, 0.05
"""Squared error above the best formula's that a number saved is worth: relative to it, and to the best's reduction."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A formula with all numbers fitted, and its squared prediction error.

    point: its last term is the proposed one
    """

    screened: Screened
    candidate: Candidate
    point: Point
    loss: float

    def evaluate(self, z: FloatArray) -> FloatArray:
        """Return the values [n] of the proposed term at z [n]."""
        amplitude, first, second = self.point.terms.values[-1].tolist()
        return np.asarray(self.candidate.form.evaluate(z, first, second) * amplitude)


@dataclass(frozen=True, eq=False)
class Step:
    """An accepted proposal, the share of the avoidable held-out error that it removes, and its probability."""

    proposal: Proposal
    gain: float
    probability: float


def choose_simplest(proposals: Sequence[Proposal], base_loss: float) -> Proposal:
    """Return the proposal with the fewest numbers that does as well as the best."""
    best = min(proposals, key=lambda p: p.loss)
    chosen = best
    for proposal in sorted(proposals, key=lambda p: p.loss):
        saved = best.candidate.numbers - proposal.candidate.numbers
        allowed = saved * min(TOLERANCE * best.loss, SHARE_TOLERANCE * max(base_loss - best.loss, 0.0))
        if proposal.candidate.numbers < chosen.candidate.numbers and proposal.loss - best.loss <= allowed:
            chosen = proposal
    return chosen


def describe_steps(
    model: OdeModel, final: Point, steps: Sequence[Step], filtered: Sequence[Filtered], blocks: Sequence[int]
) -> tuple[Finding, ...]:
    """Return one finding per place and variable, with the numbers of the final fit.

    The curve is the formula plus what the data still ask for there; its band is that of a curve without a formula.
    """
    groups: dict[Place, list[int]] = {}
    for row, step in enumerate(steps):
        groups.setdefault(step.proposal.candidate.at, []).append(row)
    names, findings = model.variable_names, []
    for at, rows in groups.items():
        screened = screen(filtered, at, blocks, len(model.states))
        curve = (steps[rows[0]].proposal.screened if screened is None else screened).curve
        involved = (names[at.variable], *((names[at.factor],) if at.factor >= 0 else ()))
        numbers = [final.terms.values[row] for row in rows]
        forms = [steps[row].proposal.candidate.form for row in rows]
        parts = [n[0] * form.evaluate(curve.x, n[1], n[2]) for form, n in zip(forms, numbers, strict=True)]
        values = np.sum(parts, axis=0)
        evaluate = partial(_evaluate_all, tuple(zip(forms, numbers, strict=True)))
        by_size = np.argsort([-np.ptp(part) for part in parts], kind="stable")
        forms, numbers = [forms[k] for k in by_size], [numbers[k] for k in by_size]
        texts = [describe_term(form, n, *involved) for form, n in zip(forms, numbers, strict=True)]
        findings.append(
            Finding(
                model.place_names[at.place],
                involved,
                Curve(curve.x, values + curve.y, values + curve.low, values + curve.high, evaluate),
                " + ".join(texts).replace("+ -", "- "),
                " and ".join(dict.fromkeys(form.kind for form in forms)),
                min(1.0, sum(steps[row].gain for row in rows)),
                max(steps[row].probability for row in rows),
            )
        )
    return tuple(findings)


def _evaluate_all(parts: Sequence[tuple[Form, FloatArray]], z: FloatArray) -> FloatArray:
    """Return the sum [n] of formulas with their numbers at z [n]."""
    return np.asarray(
        np.sum([numbers[0] * form.evaluate(z, numbers[1], numbers[2]) for form, numbers in parts], axis=0)
    )
