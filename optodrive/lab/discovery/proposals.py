"""Proposed formulas of a term with all numbers fitted, and the choice of the simplest that does as well as the best."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.discovery.fitting import Point
from optodrive.lab.discovery.screening import Candidate, Screened

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
