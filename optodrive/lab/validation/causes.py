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
    """Hypothesis on an error of Text S1, with one free parameter.

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


GAS_CAUSES, LIFT_CAUSES, FORCE_CAUSES = (
    ("gas_membrane", "gas_share"),
    ("membrane_plate", "gas_membrane"),
    ("force_area", "load_cell_gives"),
)
THERMAL_MEASUREMENT = "the absorber's temperature during a pulse and the cooling after it, at three powers"

CAUSES = (
    CauseHypothesis(
        "gas_lag",
        "the gas lags the absorber by a time constant other than R_air C_air / 2",
        # Conduction over half the cavity, 1.2 ms, to 64 ms of Text S1 and slower corners.
        ParameterRange("tau_g", "s", 1e-3, 0.1),
        "displacement at 10 kHz through the first 10 ms of a pulse",
    ),
    CauseHypothesis(
        "gas_share",
        "the gas settles at a share of the absorber's rise other than half",
        # Half at most, conduction both ways.
        ParameterRange("share", "1", 0.1, 0.5),
        "pressure in a closed cavity together with displacement",
        GAS_CAUSES,
    ),
    CauseHypothesis(
        "membrane_plate",
        "the constant of the membrane's plate formula differs from 3/1280",
        # 3/16 of a clamped plate is 80 times as much; the added gas volume compensates part of it.
        ParameterRange("kappa_factor", "1", 0.05, 80.0),
        "displacement against a known static pressure, to 1 mm",
        LIFT_CAUSES,
    ),
    CauseHypothesis(
        "gas_membrane",
        "the membrane stretches and the gas volume grows: neither plate nor constant volume",
        # Half at most, conduction both ways; E, ν, h, r, V are the paper's.
        ParameterRange("share", "1", 0.1, 0.5),
        "displacement against a known static pressure, to 1 mm",
        (*LIFT_CAUSES, *GAS_CAUSES),
        replaces_law=True,
    ),
    CauseHypothesis(
        "force_area",
        "the blocked force was measured on less than the whole aperture",
        # At most the aperture.
        ParameterRange("area", "m^2", 0.1e-6, 7.07e-6),
        "blocked force with probes of two areas, and the pressure in the cavity beside it",
        FORCE_CAUSES,
    ),
    CauseHypothesis(
        "load_cell_gives",
        "the blocked membrane yielded: the gas volume grew against the load cell",
        # Volume per pascal: 0.08 µL to several cavities at 8 kPa.
        ParameterRange("compliance", "m^3/Pa", 1e-14, 1e-11),
        "blocked force with probes of two areas, and the pressure in the cavity beside it",
        FORCE_CAUSES,
    ),
    CauseHypothesis(
        "absorber_resistance",
        "all bridge resistances are wrong by one factor",
        # R was fitted to the first 30 ms of a longer rise.
        ParameterRange("r_factor", "1", 0.7, 1.4),
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "absorber_capacity",
        "all heat capacities of the absorbers are wrong by one factor",
        # The gas's share of 10 %, and C scattered by 16 %.
        ParameterRange("c_factor", "1", 0.7, 1.4),
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "absorbed_power",
        "the absorbed power is wrong by one factor",
        # 2.45 W or 2.5 W, two estimates of the absorption.
        ParameterRange("power_factor", "1", 0.8, 1.2),
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "bridge_conductivity",
        "the bridges conduct worse when hot",
        # k ~ 1/T is 1 (Text S2).
        ParameterRange("exponent", "1", 0.0, 1.3),
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "radiation",
        "the hot absorber radiates",
        # Both faces of absorber and bridges.
        ParameterRange("emitting_area", "m^2", 0.0, 2e-5),
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "wall_heating",
        "the wall at the outer end of the bridges warms up",
        # A cell of the laminate to its surroundings, 1.2 s with its capacity.
        ParameterRange("resistance", "K/W", 0.0, 40.0),
        "displacement through a train of seconds",
    ),
    CauseHypothesis(
        "panel_heating",
        "the whole panel around the walls warms up",
        # Still air around 162 × 162 mm, 2 K/W, to a sample of 30 × 30 mm; 200 s with its capacity.
        ParameterRange("resistance", "K/W", 0.0, 60.0),
        "displacement of a pixel without light through ten minutes of light on another",
    ),
    CauseHypothesis(
        "laser_late",
        "the light of every pulse starts late",
        # Driver and diode, 0.02 to 3 ms, less at 200 Hz; a ramp loses as much energy as a delay.
        ParameterRange("delay", "s", 1e-5, 2.4e-3),
        "a photodiode beside the sample",
    ),
    CauseHypothesis(
        "dead_time",
        "a pixel rate includes time without light per pulse: move and settling of the mirrors",
        # Small steps of low-cost mirrors 0.3 ms, large steps several ms; the paper states pulse times only.
        ParameterRange("dead_time", "s", 1e-4, 5e-3),
        "pixel rates at two pixel distances, with mirror positions",
    ),
    CauseHypothesis(
        "rate_pixel",
        "the pixel rates belong to a bridge width other than 0.55 mm",
        # The widths of Table S3.
        ParameterRange("width", "m", 0.2e-3, 0.75e-3),
        "displacement against pulse width on the pixel of Fig. 3F",
    ),
    CauseHypothesis(
        "rate_power",
        "the pixel rates were taken with less than full power",
        # Fig. 3F states full power; the scanning optics attenuate it.
        ParameterRange("power_factor", "1", 0.3, 1.0),
        "power at the sample during the scan of Fig. 3F",
    ),
)
"""All causes that can be identified."""

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
        return {
            key: CAUSES_BY_KEY[key].parameter.compute_value(fraction)
            for key, fraction in zip(self.keys, self.fractions, strict=True)
        }

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
        # Stop where even a perfect fit of a larger set would cost more than the best set.
        while (
            beam
            and compute_cost(compute_aicc(0.0, len(beam[0].keys) + 1, len(self.data)), len(beam[0].keys) + 1)
            < best.cost
        ):
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
        return [
            cause
            for cause in CAUSES
            if cause.key not in keys and cause.key not in excluded and not set(cause.excludes) & set(keys)
        ]

    def _compute_residuals(self, keys: tuple[str, ...], fractions: FloatArray) -> FloatArray:
        values = {
            key: CAUSES_BY_KEY[key].parameter.compute_value(fraction)
            for key, fraction in zip(keys, fractions.tolist(), strict=True)
        }
        return np.asarray(CorrectedModel(self.base, values).compute_log_errors(self.data) / self._sigma)

    def _fit_from_starts(self, keys: tuple[str, ...], start_fit: "CauseFit | None") -> CauseFit:
        """Fit from the best of several starts of the causes that are not in start_fit."""
        start_values = {} if start_fit is None else dict(zip(start_fit.keys, start_fit.fractions, strict=True))
        is_new = any(key not in start_values for key in keys)
        starts = [
            np.array([start_values.get(key, start) for key in keys])
            for start in (START_FRACTIONS if is_new else (0.0,))
        ]
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
