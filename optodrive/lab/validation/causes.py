"""Search for the causes that explain the measured facts: least squares and a corrected information criterion.

Each hypothesis on an error of Text S1 has one free parameter within physical limits. The criterion and a prior per
cause give the probabilities of all sets that were fitted; `lab.inference` claims from these.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, inf, log
from types import MappingProxyType

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Probabilities
from optodrive.lab.inference.claim import Alternative, Evidence, HeldOutChange
from optodrive.lab.inference.fit import fit_residuals
from optodrive.lab.validation.corrected_model import CorrectedModel
from optodrive.lab.validation.facts import Datum
from optodrive.physics.paper_facts import read_shipped_table
from optodrive.physics.parameters import ParameterSet


@dataclass(frozen=True)
class ParameterRange:
    """Plausible range of a parameter: equally likely throughout, by its logarithm if the range excludes zero."""

    symbol: str
    unit: str
    low: float
    high: float

    def compute_value(self, fraction: float) -> float:
        """Return the parameter at a fraction of its range, 0 to 1."""
        if self.low > 0.0:
            return exp(log(self.low) + fraction * log(self.high / self.low))
        return self.low + fraction * (self.high - self.low)


@dataclass(frozen=True)
class CauseHypothesis:
    """Hypothesis on an error of Text S1, with one free parameter: a row of configs/paper_causes.csv.

    deciding_measurement: the measurement that would confirm it; excludes: causes for the same
    quantity, which make no sense together; replaces_law: it replaces a law of the nominal model that no value of its
    parameter reproduces
    """

    key: str
    description: str
    parameter: ParameterRange
    deciding_measurement: str
    excludes: tuple[str, ...] = ()
    replaces_law: bool = False


def _parse_cause(row: dict[str, str]) -> CauseHypothesis:
    return CauseHypothesis(
        row["key"],
        row["description"],
        ParameterRange(row["symbol"], row["unit"], float(row["low"]), float(row["high"])),
        row["deciding_measurement"],
        tuple(row["excludes"].split()),
        row["replaces_law"] == "yes",
    )


CAUSES = tuple(map(_parse_cause, read_shipped_table("paper_causes.csv")))
"""All causes that can be identified. The file states the reason of each range."""

CAUSES_BY_KEY = {cause.key: cause for cause in CAUSES}


START_FRACTIONS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Start positions of a fit in the range of a parameter."""
FRACTION_STEP = 1e-3
"""Step of finite differences."""
CHI2_DIGITS = 2
"""Decimal digits of χ² that a fit determines."""
BEAM_WIDTH = 3
"""Number of sets of each size that are extended."""
REQUIRED_ODDS = 20.0
"""Odds at which one explanation is preferred to another."""
CAUSE_COST = 2.0 * log(REQUIRED_ODDS * len(CAUSES))
"""Decrease of the criterion required per cause: REQUIRED_ODDS after all causes were equally likely a priori."""
AICC_INDISTINGUISHABLE = 2.0 * log(REQUIRED_ODDS)
"""Explanations within this difference of the criterion cannot be told apart."""


@dataclass(frozen=True)
class CauseFit:
    """Set of causes with the positions in their ranges that fit best, χ² and the criterion. Lower is better.

    sigma: standard deviations of the positions
    """

    keys: tuple[str, ...]
    fractions: tuple[float, ...]
    sigma: tuple[float, ...]
    chi2: float
    aicc: float

    @property
    def values(self) -> dict[str, float]:
        """Parameters of the causes, SI."""
        return _compute_values(self.keys, self.fractions)

    @property
    def cost(self) -> float:
        """Criterion plus the cost of the causes."""
        return compute_cost(self.aicc, len(self.keys))

    def interval(self, key: str) -> tuple[float, float]:
        """Return the linearised 95 % interval of a cause's parameter, clipped to its range."""
        row, compute = self.keys.index(key), CAUSES_BY_KEY[key].parameter.compute_value
        low, high = (min(max(self.fractions[row] + side * self.sigma[row], 0.0), 1.0) for side in (-1.96, 1.96))
        return compute(low), compute(high)

    @property
    def at_limit(self) -> tuple[str, ...]:
        """Causes whose parameter lies at a limit of its range."""
        pairs = zip(self.keys, self.fractions, strict=True)
        return tuple(key for key, fraction in pairs if min(fraction, 1.0 - fraction) < 1e-3)


def _compute_values(keys: Sequence[str], fractions: Sequence[float]) -> dict[str, float]:
    pairs = zip(keys, fractions, strict=True)
    return {key: CAUSES_BY_KEY[key].parameter.compute_value(fraction) for key, fraction in pairs}


class CauseSearch:
    """Search over sets of causes for given facts and a base parameter set, with a cache of all fits."""

    def __init__(self, base: ParameterSet, data: Sequence[Datum]) -> None:
        self.base, self.data = base, tuple(data)
        self._sigma = np.array([datum.sigma for datum in data])
        self._fits: dict[frozenset[str], CauseFit] = {}
        self.nominal = self._fit_from_starts((), None)
        self._fits[frozenset()] = self.nominal

    def build_model(self, fit: CauseFit) -> CorrectedModel:
        """Return the model of a fit."""
        return CorrectedModel(self.base, fit.values)

    def fit(self, keys: Sequence[str], start_fit: CauseFit | None = None) -> CauseFit:
        """Fit causes together.

        start_fit: a fit of most of them that provides the start
        """
        cached = self._fits.get(frozenset(keys))
        if cached is None:
            cached = self._fit_from_starts(tuple(keys), start_fit or self.nominal)
            self._fits[frozenset(keys)] = cached
        return cached

    def choose(self) -> CauseFit:
        """Return the set with the least cost, by beam search over the size of the set.

        Causes mask each other (a lag looks like a softer membrane until a dead time is added), so each size keeps
        BEAM_WIDTH sets.
        """
        best, beam = self.nominal, [self.nominal]
        while beam:
            size = len(beam[0].keys) + 1
            # Stop where even a perfect fit of a larger set would cost more than the best set.
            if compute_cost(compute_aicc(0.0, size, len(self.data)), size) >= best.cost:
                break
            larger = {frozenset(fit.keys): fit for parent in beam for fit in self.fit_additions(parent)}
            beam = sorted(larger.values(), key=lambda fit: _rank(fit, fit.aicc))[:BEAM_WIDTH]
            best = min([best, *beam], key=lambda fit: _rank(fit, fit.cost))
        return best

    def fit_additions(self, fit: CauseFit) -> list[CauseFit]:
        """Return the fits with one further cause that is compatible with the set."""
        return [self.fit((*fit.keys, cause.key), fit) for cause in self._list_allowed(fit.keys)]

    def fit_removals(self, fit: CauseFit) -> dict[str, CauseFit]:
        """Return the fits without each of the causes."""
        return {key: self.fit([other for other in fit.keys if other != key], fit) for key in fit.keys}

    def fit_exchanges(self, fit: CauseFit) -> dict[tuple[str, str], CauseFit]:
        """Return the fits with another cause in place of each: (cause, other) → fit."""
        out = {}
        for key in fit.keys:
            rest = [other for other in fit.keys if other != key]
            for cause in self._list_allowed(rest):
                if cause.key != key:
                    out[key, cause.key] = self.fit((*rest, cause.key), fit)
        return out

    def compute_chi2_terms(self, fit: CauseFit) -> FloatArray:
        """Return the contribution of each fact to χ²."""
        return np.asarray(self._compute_residuals(fit.keys, np.array(fit.fractions)) ** 2)

    def compute_max_chi2_increase(self, fit: CauseFit, key: str) -> float:
        """Return the largest increase of χ² by a further cause at the limits of its range, all else as fitted."""
        keys = (*fit.keys, key)
        ends = (self._compute_residuals(keys, np.array([*fit.fractions, end])) for end in (0.0, 1.0))
        return max(float(end @ end) for end in ends) - fit.chi2

    def weigh(self) -> Probabilities:
        """Return the probabilities of all sets that were fitted, and of one that is not among them.

        An unknown explanation would meet the facts within their errors, and cost a cause more than the best set does.
        """
        best = min(self._fits.values(), key=lambda fit: fit.cost)
        cost = {tuple(sorted(fit.keys)): fit.cost for fit in self._fits.values()}
        unknown = len(self.data) + CAUSE_COST * (len(best.keys) + 1)
        lowest = min(unknown, best.cost)
        total = sum(exp(0.5 * (lowest - each)) for each in (*cost.values(), unknown))
        probability = {keys: exp(0.5 * (lowest - each)) / total for keys, each in cost.items()}
        return Probabilities(probability.pop(()), exp(0.5 * (lowest - unknown)) / total, probability)

    def collect_evidence(
        self, held_out: Sequence[HeldOutChange] = (), doubts: Mapping[str, str] = MappingProxyType({})
    ) -> Evidence:
        """Return the evidence for all sets that were fitted.

        held_out: changes of facts predicted by causes chosen and fitted without them; doubts: on causes
        """
        probabilities = self.weigh()
        excess = max(self.nominal.chi2 - len(self.data), 1e-12)
        alternatives = []
        for keys, _ in probabilities.ranked:
            fit = self._fits[frozenset(keys)]
            share = min(1.0, (self.nominal.chi2 - fit.chi2) / excess)
            limits = dict.fromkeys(fit.at_limit, "its fit ended at a limit of its range")
            mine = {key: clause for key, clause in (dict(doubts) | limits).items() if key in keys}
            alternatives.append(Alternative(fit.keys, (share, share), tuple(held_out), mine))
        return Evidence(probabilities, tuple(alternatives))

    def _list_allowed(self, keys: Sequence[str]) -> list[CauseHypothesis]:
        excluded = {other for key in keys for other in CAUSES_BY_KEY[key].excludes}
        excluded |= set(keys)
        return [cause for cause in CAUSES if cause.key not in excluded and not set(cause.excludes) & set(keys)]

    def _compute_residuals(self, keys: tuple[str, ...], fractions: FloatArray) -> FloatArray:
        values = _compute_values(keys, fractions.tolist())
        return np.asarray(CorrectedModel(self.base, values).compute_log_errors(self.data) / self._sigma)

    def _fit_from_starts(self, keys: tuple[str, ...], start_fit: "CauseFit | None") -> CauseFit:
        """Fit from the best of several starts of the causes that are not in start_fit."""
        start_values = {} if start_fit is None else dict(zip(start_fit.keys, start_fit.fractions, strict=True))
        is_new = any(key not in start_values for key in keys)
        places = START_FRACTIONS if is_new else (0.0,)
        starts = [np.array([start_values.get(key, start) for key in keys]) for start in places]
        found = fit_residuals(
            lambda fractions: self._compute_residuals(keys, fractions),
            min(starts, key=lambda fractions: float((self._compute_residuals(keys, fractions) ** 2).sum())),
            (np.zeros(len(keys)), np.ones(len(keys))),
            FRACTION_STEP,
            method="dogbox",
        )
        aicc = compute_aicc(found.chi2, len(keys), len(self.data))
        return CauseFit(keys, tuple(found.x.tolist()), tuple(found.sigma.tolist()), found.chi2, aicc)


def _rank(fit: CauseFit, criterion: float) -> tuple[float, list[int]]:
    """Return a sorting key by a criterion.

    Where it is equal to within a fit's convergence, the order of CAUSES decides.
    Two causes of one fact fit it equally well: the last digits, which depend on the processor, must not choose.
    """
    return round(criterion, CHI2_DIGITS), sorted(CAUSES.index(CAUSES_BY_KEY[key]) for key in fit.keys)


def compute_aicc(chi2: float, cause_count: int, fact_count: int) -> float:
    """Return Akaike's criterion corrected for small samples. Errors are known, so χ² is −2 log likelihood."""
    spare = fact_count - cause_count - 1
    return chi2 + 2.0 * cause_count + 2.0 * cause_count * (cause_count + 1) / spare if spare > 0 else inf


def compute_cost(aicc: float, cause_count: int) -> float:
    """Return the criterion plus the cost of the causes. The set with the least cost is chosen."""
    return aicc + CAUSE_COST * cause_count
