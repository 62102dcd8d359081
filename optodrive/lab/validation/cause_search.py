"""Which causes the measured facts ask for: fits, a criterion for few numbers, the choice among sets of causes."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.validation.candidate_causes import CAUSES, CauseHypothesis, index_causes
from optodrive.lab.validation.corrected_model import CorrectedModel
from optodrive.lab.validation.measured_facts import Datum
from optodrive.physics.parameters import ParameterSet

START_FRACTIONS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Shares of a cause's range at which its fit may begin."""
FRACTION_STEP = 1e-3
"""Of a share, for differences."""
MAX_ITERATIONS = 25
CHI2_CONVERGED = 1e-2
"""A fit ends where a round gains less of χ²."""
BEAM_WIDTH = 3
"""Sets of each size from which larger ones are made."""
REQUIRED_ODDS = 20.0
"""Odds at which one explanation is preferred to another."""
CAUSE_COST = 2.0 * log(REQUIRED_ODDS * len(CAUSES))
"""By so much each cause must lower the criterion: odds of SURE after as many causes had an equal chance before."""
AICC_INDISTINGUISHABLE = 2.0 * log(REQUIRED_ODDS)
"""Explanations whose criteria differ by less cannot be told apart."""


@dataclass(frozen=True)
class CauseFit:
    """Causes at work, the shares of their ranges that fit best, χ² and the criterion; lower is better."""

    keys: tuple[str, ...]
    fractions: tuple[float, ...]
    chi2: float
    aicc: float

    @property
    def values(self) -> dict[str, float]:
        """The causes' numbers, SI."""
        return {
            key: index_causes()[key].compute_value(share) for key, share in zip(self.keys, self.fractions, strict=True)
        }

    @property
    def cost(self) -> float:
        """The criterion and the price of the causes."""
        return compute_cost(self.aicc, len(self.keys))

    @property
    def at_limit(self) -> tuple[str, ...]:
        """Causes whose number lies at an end of its range."""
        pairs = zip(self.keys, self.fractions, strict=True)
        return tuple(key for key, share in pairs if min(share, 1.0 - share) < 1e-3)


class CauseSearch:
    """The facts in data, the set they are held against, and every fit made so far."""

    def __init__(self, base: ParameterSet, data: Sequence[Datum], causes: Sequence[CauseHypothesis] = CAUSES) -> None:
        self.base, self.data, self.causes = base, tuple(data), tuple(causes)
        self._sigma = np.array([datum.sigma for datum in data])
        self._fits: dict[frozenset[str], CauseFit] = {}
        self.nominal = self._evaluate((), np.zeros(0))
        self._fits[frozenset()] = self.nominal

    def build_model(self, fit: CauseFit) -> CorrectedModel:
        """The model of a fit."""
        return CorrectedModel(self.base, fit.values)

    def fit(self, keys: Sequence[str], start_fit: CauseFit | None = None) -> CauseFit:
        """Causes fitted together; near: a fit of most of them, to begin from."""
        cached = self._fits.get(frozenset(keys))
        if cached is None:
            cached = self._fit_from_starts(tuple(keys), start_fit or self.nominal)
            self._fits[frozenset(keys)] = cached
        return cached

    def choose(self) -> CauseFit:
        """The set of causes that is worth the most, found size by size from the BEAM best sets one smaller.

        Causes hide each other (a lag looks like a softer membrane until a dead time is there), so one set a size is
        not enough to go on from.
        """
        best, beam = self.nominal, [self.nominal]
        # Where even a perfect fit would cost more than the best set so far, no larger one needs a look.
        while (
            beam
            and compute_cost(compute_aicc(0.0, len(beam[0].keys) + 1, len(self.data)), len(beam[0].keys) + 1)
            < best.cost
        ):
            larger = {frozenset(fit.keys): fit for parent in beam for fit in self.fit_additions(parent)}
            beam = sorted(larger.values(), key=lambda fit: fit.aicc)[:BEAM_WIDTH]
            best = min([best, *beam], key=lambda fit: fit.cost)
        return best

    def fit_additions(self, fit: CauseFit) -> list[CauseFit]:
        """With each further cause that may stand beside those at work."""
        return [self.fit((*fit.keys, cause.key), fit) for cause in self._list_allowed(fit.keys)]

    def fit_removals(self, fit: CauseFit) -> dict[str, CauseFit]:
        """Without each cause."""
        return {key: self.fit([other for other in fit.keys if other != key], fit) for key in fit.keys}

    def fit_exchanges(self, fit: CauseFit) -> dict[tuple[str, str], CauseFit]:
        """With another cause in the place of each: (cause, other) → fit."""
        out = {}
        for key in fit.keys:
            rest = [other for other in fit.keys if other != key]
            for cause in self._list_allowed(rest):
                if cause.key != key:
                    out[key, cause.key] = self.fit((*rest, cause.key), fit)
        return out

    def compute_chi2_terms(self, fit: CauseFit) -> FloatArray:
        """What each fact adds to χ²."""
        return np.asarray(self._compute_residuals(fit.keys, np.array(fit.fractions)) ** 2)

    def compute_interval(self, fit: CauseFit, key: str) -> tuple[float, float]:
        """95 % of a cause's number, by the slopes at the fit, within its range."""
        fractions = np.array(fit.fractions)
        slopes = self._compute_jacobian(fit.keys, fractions, self._compute_residuals(fit.keys, fractions))
        place = fit.keys.index(key)
        sigma = float(np.sqrt(np.linalg.pinv(slopes.T @ slopes)[place, place]))
        low, high = np.clip(
            [fit.fractions[place] - 1.96 * sigma, fit.fractions[place] + 1.96 * sigma], 0.0, 1.0
        ).tolist()
        return index_causes()[key].compute_value(low), index_causes()[key].compute_value(high)

    def compute_max_chi2_increase(self, fit: CauseFit, key: str) -> float:
        """The most that a further cause adds to χ² anywhere in its range, everything else as fitted."""
        ends = (self._evaluate((*fit.keys, key), np.array([*fit.fractions, share])) for share in (0.0, 1.0))
        return max(end.chi2 for end in ends) - fit.chi2

    def _list_allowed(self, keys: Sequence[str]) -> list[CauseHypothesis]:
        excluded = {other for key in keys for other in index_causes()[key].excludes}
        return [
            cause
            for cause in self.causes
            if cause.key not in keys and cause.key not in excluded and not set(cause.excludes) & set(keys)
        ]

    def _compute_residuals(self, keys: tuple[str, ...], fractions: FloatArray) -> FloatArray:
        causes = index_causes()
        values = {key: causes[key].compute_value(share) for key, share in zip(keys, fractions.tolist(), strict=True)}
        return np.asarray(CorrectedModel(self.base, values).compute_log_errors(self.data) / self._sigma)

    def _evaluate(self, keys: tuple[str, ...], fractions: FloatArray) -> CauseFit:
        chi2 = float((self._compute_residuals(keys, fractions) ** 2).sum())
        return CauseFit(keys, tuple(fractions.tolist()), chi2, compute_aicc(chi2, len(keys), len(self.data)))

    def _fit_from_starts(self, keys: tuple[str, ...], start_fit: CauseFit) -> CauseFit:
        known = dict(zip(start_fit.keys, start_fit.fractions, strict=True))
        new_keys = [key for key in keys if key not in known]
        starts = [
            np.array([known.get(key, start) for key in keys]) for start in (START_FRACTIONS if new_keys else (0.0,))
        ]
        start = min(starts, key=lambda shares: float((self._compute_residuals(keys, shares) ** 2).sum()))
        return self._evaluate(keys, self._minimize(keys, start))

    def _minimize(self, keys: tuple[str, ...], fractions: FloatArray) -> FloatArray:
        """Levenberg and Marquardt, held to the ranges."""
        if not keys:
            return fractions
        damping, residuals = 1e-2, self._compute_residuals(keys, fractions)
        chi2 = float(residuals @ residuals)
        for _ in range(MAX_ITERATIONS):
            slopes = self._compute_jacobian(keys, fractions, residuals)
            descent = -slopes.T @ residuals
            # A number that pushes against its limit is held there, so that the others move freely.
            held = ((fractions <= 0.0) & (descent < 0.0)) | ((fractions >= 1.0) & (descent > 0.0))
            free = ~held
            reduction = 0.0
            while free.any() and damping < 1e6:
                normal = slopes[:, free].T @ slopes[:, free]
                step = np.linalg.solve(
                    normal + damping * (np.diag(np.diag(normal)) + 1e-9 * np.eye(len(normal))), descent[free]
                )
                trial = fractions.copy()
                trial[free] = np.clip(fractions[free] + step, 0.0, 1.0)
                trial_residuals = self._compute_residuals(keys, trial)
                reduction = chi2 - float(trial_residuals @ trial_residuals)
                if reduction > 0.0:
                    fractions, residuals, chi2, damping = (
                        trial,
                        trial_residuals,
                        chi2 - reduction,
                        max(damping / 10.0, 1e-9),
                    )
                    break
                damping *= 10.0
            if reduction < CHI2_CONVERGED:
                return fractions
        return fractions

    def _compute_jacobian(self, keys: tuple[str, ...], fractions: FloatArray, residuals: FloatArray) -> FloatArray:
        columns = []
        for number in range(len(keys)):
            moved = fractions.copy()
            moved[number] += FRACTION_STEP if moved[number] < 0.5 else -FRACTION_STEP
            columns.append((self._compute_residuals(keys, moved) - residuals) / (moved[number] - fractions[number]))
        return np.stack(columns, axis=1)


def compute_aicc(chi2: float, cause_count: int, fact_count: int) -> float:
    """Akaike's with its correction for few numbers; the errors are known, χ² is −2 log of the likelihood."""
    spare = fact_count - cause_count - 1
    return chi2 + 2.0 * cause_count + 2.0 * cause_count * (cause_count + 1) / spare if spare > 0 else inf


def compute_cost(aicc: float, cause_count: int) -> float:
    """A criterion and the price of so many causes: the set with the least is chosen."""
    return aicc + CAUSE_COST * cause_count
