"""Marginal likelihoods of the explanations of a recording, and the probabilities that follow from them.

Theory of operation

Explanations. A recording shows no effect, one cause of the catalogue, two of them, or something else. Each but the last
is a fitted model; its marginal likelihood is Laplace's: χ² at the best fit, and the share of the prior volume that the
data leave (Occam's factor). Sizes of effects have a prior that is uniform in their logarithm, over two decades: a fit
that ends at no effect costs nothing and gains nothing.

Something else. A cause outside the catalogue has no model. It is represented by a flexible one: an independent mean in
every bin of the omnibus test (group, signal, time after an edge), normal, of a size that is integrated over, beside the
nominal model or beside a fitted cause. A real cause hardly ever has exactly its term's form, so a fitted cause is also
given columns of its own effect in other forms (`compute_discrepancy_basis`), with a prior on their coefficients. What
the bins take beside a cause belongs to that cause in another form if the cause explains nearly all, and to none of
these if it explains less; the same holds for its own other forms, with a more lenient share (`compute_own_share`).

Nothing. A cause may also act so weakly that no recording of this kind could show it, and a recording without any effect
does not make that less probable. What of a cause's probability lies at such sizes (`compute_hidden_share`) counts as no
effect, which is thus: none, or none that would have been seen.

Noise. The noise model is an estimate from few repeats, so a difference in evidence is worth less the larger it is: it
is converted as the likelihood of a Student distribution with the degrees of freedom of the noise (`temper`), relative
to the best explanation, so that rivals which nearly agree are compared almost as normal ones.

The priors, the two shares and the temperature were set on development seeds of the blind generator, whose
reliability diagram `scripts/bench calibration` draws on others.

Certainty of the noise. The noise model is an estimate: of the jitters of power and timing and of the baselines from as
many values as there are repeats, some ten to twenty; of the samples' noise from thousands. A difference of χ² is worth
as much as the noise that it is measured by is known: an effect that looks like a change of the power is measured by the
jitter of the power, one within a pulse by the samples' noise. So each variance is changed alone, and the relative
change of the difference is its share. With the relative variances of these estimates, 2 / ν each, the difference has a
relative variance of Σ share² · 2 / ν, which is that of one variance known to ν degrees of freedom (after
Satterthwaite).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import exp, log, log1p

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Probabilities
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jitter_sensitivity, compute_normal_equations
from optodrive.lab.diagnosis.noise_model import NoiseModel
from optodrive.physics.hypothesis import FreeParameter

PRIOR_NO_EFFECT, PRIOR_ONE_CAUSE, PRIOR_TWO_CAUSES, PRIOR_NONE_OF_THESE = 0.5, 0.35, 0.05, 0.1
"""Prior probabilities before any data; those of one and of two causes are shared among all of them."""
OTHER_ODDS = 0.3
"""Prior odds that beside a fitted cause there is something else, or that it has another form."""
SIZE_LOG_SPAN = log(100.0)
"""Span of the logarithm of an effect's size a priori."""
FORM_SIGMAS = (0.05, 0.1, 0.2, 0.4)
"""Prior standard deviations of the coefficients of other forms, relative to the effect; averaged over."""
BIN_VARIANCES = tuple(np.geomspace(0.1, 1e5, 13).tolist())
"""Prior variances of the means of bins, in their noise; averaged over."""
FORM_REST, BINS_REST, PAIR_REST, REST_POWER = 0.4, 0.03, 0.03, 4.0
"""Share of the excess left over at which a rest, taken by other forms, by bins, or by a second cause that leaves a rest
too, is as likely another cause's."""
MAX_FORM_PROBABILITY = 0.95
"""Largest probability that the second cause of a pair only mends the form of the first one."""
HIDDEN_SIGMA = 2.0
"""Size of an effect, in σ, below which nobody would have seen it."""
SIGMAS = np.geomspace(0.1, 100.0, 400)
"""Sizes of effects, in σ, over which the share of those that nobody would have seen is computed."""
UNIFORM_VARIANCE = 1.0 / 12.0
"""Variance of a uniform distribution over a unit range."""


@dataclass(frozen=True)
class Explanation:
    """A model of the recording.

    causes: none for no effect or for something else; degrees: degrees of freedom of the noise by which it differs from
    the best explanation; own_share: probability that these causes, rather than something else, are what it describes;
    hidden: probability that their effect is too small to be seen
    """

    causes: tuple[str, ...]
    log_prior: float
    log_evidence: float
    degrees: float
    own_share: float = 1.0
    hidden: float = 0.0


def compute_log_evidence(problem: FitProblem, fitted: ModelFit) -> float:
    """Return the logarithm of the marginal likelihood of a fit, up to a constant of the data."""
    count = len(problem.prior.sigma) + len(fitted.free)
    # Without the last column, the residual's.
    hessian = fitted.gram[:count, :count]
    precision = [1.0 / sigma**2 for sigma in problem.prior.sigma]
    scale = np.ones(count)
    for row, free in enumerate(fitted.free, start=len(precision)):
        if is_size(free):
            # The derivative by the logarithm is the derivative times the size: at no effect it is zero, and Occam's
            # factor 1.
            scale[row] = free.read_value(fitted.point.terms)
            precision.append(1.0 / (UNIFORM_VARIANCE * SIZE_LOG_SPAN**2))
        else:
            low, high = free.limits
            # A uniform prior as the normal one of equal variance, for which Laplace's integral is closed.
            precision.append(1.0 / (UNIFORM_VARIANCE * (high - low) ** 2))
    root = np.sqrt(precision)
    # Relative to the prior: a number that the data leave open costs nothing.
    relative = np.eye(count) + hessian * np.outer(scale / root, scale / root)
    return -0.5 * (fitted.chi2 + float(np.linalg.slogdet(relative)[1]))


def is_size(free: FreeParameter) -> bool:
    """Return whether a fitted number scales an effect that vanishes with it."""
    return not free.logarithmic and not free.parameter.is_shape


def compute_score_evidence(ratio: float) -> float:
    """Return the gain in log evidence of an effect of this likelihood ratio that was not refitted."""
    return 0.5 * (ratio - log1p(ratio * UNIFORM_VARIANCE * SIZE_LOG_SPAN**2))


def compute_hidden_share(ratio: float) -> float:
    """Return the posterior probability that an effect of this likelihood ratio is smaller than `HIDDEN_SIGMA`.

    The logarithm of its size is uniform a priori, as in `compute_log_evidence`.
    """
    # The likelihood of a size s, in σ, where the best one is √ratio: exp(s √ratio − s²/2).
    logs = SIGMAS * max(ratio, 0.0) ** 0.5 - 0.5 * SIGMAS**2
    weights = np.exp(logs - logs.max())
    return float(weights[SIGMAS < HIDDEN_SIGMA].sum() / weights.sum())


def compute_form_evidence(gram: FloatArray, right: FloatArray) -> float:
    """Return the gain in log evidence by columns with normal coefficients of `FORM_SIGMAS`, averaged over these.

    gram: [k, k] of the whitened columns, fitted parameters projected out; right: [k] with the residual
    """
    values, vectors = np.linalg.eigh(gram)
    # Rounding makes the smallest eigenvalues negative.
    values, projected = np.maximum(values, 0.0), vectors.T @ right
    gains = []
    for sigma in FORM_SIGMAS:
        inflation = 1.0 + sigma**2 * values
        gains.append(0.5 * float((sigma**2 * projected**2 / inflation - np.log(inflation)).sum()))
    return average_log(gains)


@dataclass(frozen=True, eq=False)
class BinEvidence:
    """Evidence for free means of bins, for each prior variance of these.

    gains: [v] in log evidence; rests: [v] χ² that they are expected to take then
    """

    gains: FloatArray
    rests: FloatArray

    @property
    def log_evidence(self) -> float:
        """Gain in log evidence, averaged over the variances."""
        return average_log(self.gains.tolist())

    def compute_own_share(self, reduction: float) -> float:
        """Return the probability that the rest in the bins belongs to a cause that reduced χ² by this amount."""
        # The size of the bins' means that the data prefer says whether the rest is small beside the cause.
        weights = np.exp(self.gains - np.logaddexp.reduce(self.gains))
        shares = self.rests / np.maximum(max(reduction, 0.0) + self.rests, 1e-9)
        own = [compute_own_share(share, BINS_REST) for share in shares.tolist()]
        return float(weights @ own)


def compute_bin_evidence(gram: FloatArray, right: FloatArray, noise_chi2: float, noise_degrees: int) -> BinEvidence:
    """Return the evidence for independent means of bins, normal with `BIN_VARIANCES`.

    gram: [k, k] correlations of the bins; right: [k] with the residual; noise_chi2, noise_degrees: of the same bins of
    the differences between repeats, which estimate the scale of the noise
    """
    values, vectors = np.linalg.eigh(gram)
    # Bins that the fitted parameters determine hold nothing, and their quotient would be rounding errors.
    kept = values > 1e-6 * values.max(initial=1.0)
    values, squares = values[kept], (vectors.T @ right)[kept] ** 2 / values[kept]
    degrees = max(noise_degrees, 1)
    # Repeats that differ less than the noise model says do not lower the noise: the scale is one at least. Without
    # repeats it is taken as known.
    noise = max(degrees, noise_chi2) if noise_degrees else 1e9
    degrees = degrees if noise_degrees else 10**9
    half = 0.5 * (degrees + len(values))
    gains, rests = [], []
    for variance in BIN_VARIANCES:
        inflation = 1.0 + variance * values
        # Student's likelihood, since the scale is an estimate: one outlying bin counts less than under known noise.
        likelihood = half * (log1p(float(squares.sum()) / noise) - log1p(float((squares / inflation).sum()) / noise))
        # Occam's factor of the free means.
        gains.append(likelihood - 0.5 * float(np.log(inflation).sum()))
        shrinkage = 1.0 - 1.0 / inflation
        rests.append(float((shrinkage**2 * squares + shrinkage).sum()))
    return BinEvidence(np.array(gains), np.array(rests))


def average_log(logs: Sequence[float]) -> float:
    """Return the logarithm of the mean of exponentials."""
    return float(np.logaddexp.reduce(logs)) - log(len(logs))


def compute_own_share(rest: float, middle: float) -> float:
    """Return the probability that a rest, a share of the excess, is the cause's own in another form."""
    return float(1.0 / (1.0 + (rest / middle) ** REST_POWER))


def temper(difference: float, degrees: float) -> float:
    """Return the logarithm of the odds for a difference of log evidence, with the noise known to some degrees."""
    # It grows with the logarithm of a large difference: few repeats cannot give arbitrary certainty.
    return 0.5 * (degrees + 1) * log1p(2.0 * difference / degrees)


def compute_probabilities(explanations: Iterable[Explanation]) -> Probabilities:
    """Return the probabilities of all explanations, which sum to 1."""
    items = list(explanations)
    # Tempering is not additive: the differences must be to one explanation, and the best is the one that matters.
    best = max(item.log_evidence for item in items)
    logs = np.array([item.log_prior - temper(best - item.log_evidence, item.degrees) for item in items])
    weights = np.exp(logs - np.logaddexp.reduce(logs))
    no_effect = none_of_these = 0.0
    causes: dict[tuple[str, ...], float] = {}
    for item, weight in zip(items, weights.tolist(), strict=True):
        # What a cause leaves to something else is not its own, however good the fit.
        none_of_these += weight * (1.0 - item.own_share)
        if item.causes:
            key = tuple(sorted(item.causes))
            causes[key] = causes.get(key, 0.0) + weight * item.own_share * (1.0 - item.hidden)
            # Else no recording could reach a large probability of no effect: weak effects are always possible.
            no_effect += weight * item.own_share * item.hidden
        else:
            no_effect += weight * item.own_share
    return Probabilities(no_effect, none_of_these, causes)


PRIOR_DEGREES, KNOWN_DEGREES = 6, 10_000
"""Degrees of freedom of what is known of jitters beforehand; degrees of freedom of noise that counts as known."""
MAX_DEGREES = 60
"""Largest number of degrees of freedom of estimated noise: terms are approximations, too."""
LOG_STEP = 0.1
"""Change of the logarithm of a variance."""


def count_noise_degrees(data: Dataset) -> int:
    """Return the degrees of freedom of the jitters.

    Mirror noise, raised above its estimate, counts as known.
    """
    mirrors = all(kind in MIRROR_KINDS for kind in data.kinds)
    return KNOWN_DEGREES if mirrors or not data.contrast_count else PRIOR_DEGREES + data.contrast_count


class NoiseCertainty:
    """Degrees of freedom of the noise by which fits differ from the best one."""

    def __init__(self, problem: FitProblem, best: ModelFit) -> None:
        self._problem = problem
        self._min_degrees = count_noise_degrees(problem.data)
        # Each change costs a whitening of all data; known noise needs none.
        changes = _list_changes(problem) if self._min_degrees < KNOWN_DEGREES else []
        self._noises = [problem.noise, *(noise for noise, _ in changes)]
        self._degrees = np.array([degrees for _, degrees in changes])
        self._best = self._compute_chi2(best)

    def count_degrees(self, other: ModelFit) -> float:
        """Return the degrees of freedom: those of the jitters at least, and where the fits do not differ."""
        differences = self._compute_chi2(other) - self._best
        # Fits that agree have no shares; the fewest degrees are the cautious answer.
        if not len(self._degrees) or differences[0] <= 0.0:
            return self._min_degrees
        shares = np.log(np.maximum(differences[1:] / differences[0], 1e-9)) / LOG_STEP
        variance = float((shares**2 * 2.0 / self._degrees).sum())
        return float(np.clip(2.0 / max(variance, 1e-9), self._min_degrees, max(MAX_DEGREES, self._min_degrees)))

    def _compute_chi2(self, fitted: ModelFit) -> FloatArray:
        """Return χ² of a fit, without priors, under the noise as it is and with each of its changes."""
        problem = self._problem
        residual = (problem.data.value - fitted.prediction)[:, None]
        jitter = compute_jitter_sensitivity(problem.data, fitted.point, fitted.prediction)
        equations = (compute_normal_equations(problem.data, residual, noise, jitter) for noise in self._noises)
        return np.array([item[0, 0] for item in equations])


def _list_changes(problem: FitProblem) -> list[tuple[NoiseModel, float]]:
    """Return the noise with each of its variances changed alone, and the degrees of freedom of that one."""
    data, noise, factor = problem.data, problem.noise, exp(0.5 * LOG_STEP)
    jitter_degrees = count_noise_degrees(data)
    out: list[tuple[NoiseModel, float]] = [
        (replace(noise, power_sigma=factor * noise.power_sigma), jitter_degrees),
        (replace(noise, timing_sigma_s=factor * noise.timing_sigma_s), jitter_degrees),
    ]
    # Only differences between repeats tell the noise: of two runs, one.
    share = data.contrast_count / len(data.runs)
    for kind, coloured in noise.coloured.items():
        blocks = [block for block in data.blocks if block.kind == kind]
        samples = share * sum(len(block.t_s) for block in blocks)
        duration_s = share * sum(float(block.t_s[-1] - block.t_s[0]) for block in blocks)
        baseline = noise.baseline_sigma | {kind: factor * noise.baseline_sigma[kind]}
        out.append((replace(noise, baseline_sigma=baseline), jitter_degrees))
        first, second = coloured.sigma
        changes = (
            (replace(coloured, white=factor * coloured.white), samples),
            # Slow noise is known by as many values as correlation times fit in, not by samples.
            (replace(coloured, sigma=(factor * first, second)), duration_s / coloured.tau_s[0]),
            (replace(coloured, sigma=(first, factor * second)), duration_s / coloured.tau_s[1]),
        )
        out += [
            (replace(noise, coloured=noise.coloured | {kind: item}), max(jitter_degrees, min(degrees, samples)))
            for item, degrees in changes
        ]
    return out
