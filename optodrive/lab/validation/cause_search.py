"""Which causes the measured facts ask for: fits, a criterion for few numbers, the choice among sets of causes."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.validation.candidate_causes import CATALOGUE, Cause, catalogue
from optodrive.lab.validation.corrected_model import Extended
from optodrive.lab.validation.measured_facts import Datum
from optodrive.physics.parameters import ParameterSet

STARTS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Shares of a cause's range at which its fit may begin."""
STEP = 1e-3
"""Of a share, for differences."""
ROUNDS = 25
ENOUGH = 1e-2
"""A fit ends where a round gains less of χ²."""
BEAM = 3
"""Sets of each size from which larger ones are made."""
SURE = 20.0
"""Odds at which one explanation is preferred to another."""
NAMED = 2.0 * log(SURE * len(CATALOGUE))
"""By so much each cause must lower the criterion: odds of SURE after as many causes had an equal chance before."""
APART = 2.0 * log(SURE)
"""Explanations whose criteria differ by less cannot be told apart."""


@dataclass(frozen=True)
class Fit:
    """Causes at work, the shares of their ranges that fit best, χ² and the criterion; lower is better."""

    keys: tuple[str, ...]
    shares: tuple[float, ...]
    chi2: float
    aicc: float

    @property
    def numbers(self) -> dict[str, float]:
        """The causes' numbers, SI."""
        return {key: catalogue()[key].value(share) for key, share in zip(self.keys, self.shares, strict=True)}

    @property
    def cost(self) -> float:
        """The criterion and the price of the causes."""
        return cost(self.aicc, len(self.keys))

    @property
    def at_limit(self) -> tuple[str, ...]:
        """Causes whose number lies at an end of its range."""
        pairs = zip(self.keys, self.shares, strict=True)
        return tuple(key for key, share in pairs if min(share, 1.0 - share) < 1e-3)


class Search:
    """The facts in data, the set they are held against, and every fit made so far."""

    def __init__(self, base: ParameterSet, data: Sequence[Datum], causes: Sequence[Cause] = CATALOGUE) -> None:
        self.base, self.data, self.causes = base, tuple(data), tuple(causes)
        self._sigma = np.array([datum.sigma for datum in data])
        self._fits: dict[frozenset[str], Fit] = {}
        self.nominal = self._made((), np.zeros(0))
        self._fits[frozenset()] = self.nominal

    def model(self, fit: Fit) -> Extended:
        """The model of a fit."""
        return Extended(self.base, fit.numbers)

    def fit(self, keys: Sequence[str], near: Fit | None = None) -> Fit:
        """Causes fitted together; near: a fit of most of them, to begin from."""
        known = self._fits.get(frozenset(keys))
        if known is None:
            known = self._fitted(tuple(keys), near or self.nominal)
            self._fits[frozenset(keys)] = known
        return known

    def choose(self) -> Fit:
        """The set of causes that is worth the most, found size by size from the BEAM best sets one smaller.

        Causes hide each other (a lag looks like a softer membrane until a dead time is there), so one set a size is
        not enough to go on from.
        """
        best, beam = self.nominal, [self.nominal]
        # Where even a perfect fit would cost more than the best set so far, no larger one needs a look.
        while beam and cost(criterion(0.0, len(beam[0].keys) + 1, len(self.data)), len(beam[0].keys) + 1) < best.cost:
            larger = {frozenset(fit.keys): fit for parent in beam for fit in self.additions(parent)}
            beam = sorted(larger.values(), key=lambda fit: fit.aicc)[:BEAM]
            best = min([best, *beam], key=lambda fit: fit.cost)
        return best

    def additions(self, fit: Fit) -> list[Fit]:
        """With each further cause that may stand beside those at work."""
        return [self.fit((*fit.keys, cause.key), fit) for cause in self._allowed(fit.keys)]

    def removals(self, fit: Fit) -> dict[str, Fit]:
        """Without each cause."""
        return {key: self.fit([other for other in fit.keys if other != key], fit) for key in fit.keys}

    def exchanges(self, fit: Fit) -> dict[tuple[str, str], Fit]:
        """With another cause in the place of each: (cause, other) → fit."""
        out = {}
        for key in fit.keys:
            rest = [other for other in fit.keys if other != key]
            for cause in self._allowed(rest):
                if cause.key != key:
                    out[key, cause.key] = self.fit((*rest, cause.key), fit)
        return out

    def squares(self, fit: Fit) -> FloatArray:
        """What each fact adds to χ²."""
        return np.asarray(self._residuals(fit.keys, np.array(fit.shares)) ** 2)

    def interval(self, fit: Fit, key: str) -> tuple[float, float]:
        """95 % of a cause's number, by the slopes at the fit, within its range."""
        shares = np.array(fit.shares)
        slopes = self._slopes(fit.keys, shares, self._residuals(fit.keys, shares))
        place = fit.keys.index(key)
        sigma = float(np.sqrt(np.linalg.pinv(slopes.T @ slopes)[place, place]))
        low, high = np.clip([fit.shares[place] - 1.96 * sigma, fit.shares[place] + 1.96 * sigma], 0.0, 1.0).tolist()
        return catalogue()[key].value(low), catalogue()[key].value(high)

    def most_changed(self, fit: Fit, key: str) -> float:
        """The most that a further cause adds to χ² anywhere in its range, everything else as fitted."""
        ends = (self._made((*fit.keys, key), np.array([*fit.shares, share])) for share in (0.0, 1.0))
        return max(end.chi2 for end in ends) - fit.chi2

    def _allowed(self, keys: Sequence[str]) -> list[Cause]:
        barred = {other for key in keys for other in catalogue()[key].without}
        return [
            cause
            for cause in self.causes
            if cause.key not in keys and cause.key not in barred and not set(cause.without) & set(keys)
        ]

    def _residuals(self, keys: tuple[str, ...], shares: FloatArray) -> FloatArray:
        causes = catalogue()
        numbers = {key: causes[key].value(share) for key, share in zip(keys, shares.tolist(), strict=True)}
        return np.asarray(Extended(self.base, numbers).misses(self.data) / self._sigma)

    def _made(self, keys: tuple[str, ...], shares: FloatArray) -> Fit:
        chi2 = float((self._residuals(keys, shares) ** 2).sum())
        return Fit(keys, tuple(shares.tolist()), chi2, criterion(chi2, len(keys), len(self.data)))

    def _fitted(self, keys: tuple[str, ...], near: Fit) -> Fit:
        known = dict(zip(near.keys, near.shares, strict=True))
        fresh = [key for key in keys if key not in known]
        starts = [np.array([known.get(key, start) for key in keys]) for start in (STARTS if fresh else (0.0,))]
        start = min(starts, key=lambda shares: float((self._residuals(keys, shares) ** 2).sum()))
        return self._made(keys, self._descended(keys, start))

    def _descended(self, keys: tuple[str, ...], shares: FloatArray) -> FloatArray:
        """Levenberg and Marquardt, held to the ranges."""
        if not keys:
            return shares
        damping, residuals = 1e-2, self._residuals(keys, shares)
        chi2 = float(residuals @ residuals)
        for _ in range(ROUNDS):
            slopes = self._slopes(keys, shares, residuals)
            downhill = -slopes.T @ residuals
            # A number that pushes against its limit is held there, so that the others move freely.
            held = ((shares <= 0.0) & (downhill < 0.0)) | ((shares >= 1.0) & (downhill > 0.0))
            free = ~held
            gained = 0.0
            while free.any() and damping < 1e6:
                normal = slopes[:, free].T @ slopes[:, free]
                step = np.linalg.solve(
                    normal + damping * (np.diag(np.diag(normal)) + 1e-9 * np.eye(len(normal))), downhill[free]
                )
                trial = shares.copy()
                trial[free] = np.clip(shares[free] + step, 0.0, 1.0)
                there = self._residuals(keys, trial)
                gained = chi2 - float(there @ there)
                if gained > 0.0:
                    shares, residuals, chi2, damping = trial, there, chi2 - gained, max(damping / 10.0, 1e-9)
                    break
                damping *= 10.0
            if gained < ENOUGH:
                return shares
        return shares

    def _slopes(self, keys: tuple[str, ...], shares: FloatArray, residuals: FloatArray) -> FloatArray:
        columns = []
        for number in range(len(keys)):
            moved = shares.copy()
            moved[number] += STEP if moved[number] < 0.5 else -STEP
            columns.append((self._residuals(keys, moved) - residuals) / (moved[number] - shares[number]))
        return np.stack(columns, axis=1)


def criterion(chi2: float, causes: int, facts: int) -> float:
    """Akaike's with its correction for few numbers; the errors are known, χ² is −2 log of the likelihood."""
    spare = facts - causes - 1
    return chi2 + 2.0 * causes + 2.0 * causes * (causes + 1) / spare if spare > 0 else inf


def cost(aicc: float, causes: int) -> float:
    """A criterion and the price of so many causes: the set with the least is chosen."""
    return aicc + NAMED * causes
