"""Matching: a person's sensitivity over the display, from which of two places was felt more strongly.

Theory of operation. The logarithm f of the sensitivity is a Gaussian process over the display: smooth, with an unknown
correlation length and standard deviation. A trial shows one place after the other, and the participant names the
stronger. Intensity is the stronger channel's excitation less 1 plus half the weaker one's less 1, and a sensitivity s
multiplies both. So a nominal intensity a (that of a person of sensitivity 1) at which both channels feel something is
felt as s (a + 1.5) - 1.5. The answer is "second" with the probability of a logistic function of the difference of the
logarithms of s (a + 1.5), whose scale is the participant's Weber fraction, and is a guess in a share of the trials.

The posterior of f at the compared places is Gaussian at its maximum (Laplace's approximation), and the process carries
it to the other pixels. Correlation length, standard deviation and scale are weighed by their evidence over a grid. Only
ratios are compared, so the mean of f over the display is set to 0.

The next trial compares the two places whose answer is expected to reduce the variance over all pixels most, at the
intensities that are predicted to be felt alike, where an answer tells most. Places are spread over the whole display
up to its border, because the process knows little beyond the outermost of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.physics.sensation import WEAKER_SHARE

LENGTHS = (0.25, 0.4, 0.65, 1.0)
"""Correlation lengths, in the display's longer side."""
DEVIATIONS = (0.1, 0.2, 0.4)
"""Standard deviations of the logarithm of the sensitivity."""
SCALES = (0.11, 0.16, 0.24, 0.36)
"""Scales of the logistic function: 0.16 for two stimuli with a Weber fraction of 0.2 each."""
BOTH_THRESHOLDS = 1.0 + WEAKER_SHARE
"""Sum of the channels' thresholds as intensity weighs them."""
GUESSES = 0.05
"""Share of guesses that the model allows for."""
NUGGET = 1e-4
"""Share of the variance that does not correlate between places, which keeps the covariance regular."""
REFIT_TRIALS = 50
"""Trials between two choices of the most likely length, deviation and scale, by which trials are chosen."""
STEPS_MAX, STEP_MIN = 40, 1e-5
PRESENTED_MAX = np.log(2.5)
"""Largest logarithm of a sensitivity by which the presented intensities are equalised."""


class Comparison(NamedTuple):
    """Two pixels in the order in which they are shown, and their nominal intensities."""

    first: int
    second: int
    first_intensity: float
    second_intensity: float


Answers = Sequence[tuple[Comparison, bool]]
"""Comparisons, and whether the second was felt more strongly."""


class Smoothness(NamedTuple):
    """Correlation length, in the display's longer side, standard deviation of f, and scale of the answers."""

    length: float
    deviation: float
    scale: float


TYPICAL = Smoothness(0.4, 0.2, 0.16)


class Posterior(NamedTuple):
    """Mean [n] and covariance [n, n] of f at the compared places, and the logarithm of the evidence."""

    mean: FloatArray
    covariance: FloatArray
    evidence: float


class Sensitivity(NamedTuple):
    """Sensitivity of every pixel and its standard uncertainty, [p] each."""

    sensitivity: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, eq=False)
class _Prior:
    """Covariance of the places [n, n], its inverse, and the map from them to all pixels [p, n], its mean removed.

    spread: variance of a pixel that the places do not determine, [p]
    """

    inverse: FloatArray
    log_determinant: float
    to_pixels: FloatArray
    spread: FloatArray


class MatchingModel:
    """Choice of comparisons and estimate of the sensitivity on a display.

    x_m, y_m: positions of the pixels, [p]; places: number of compared pixels; intensity: that they are shown with
    """

    def __init__(self, x_m: FloatArray, y_m: FloatArray, places: int, intensity: float) -> None:
        self._position_m = np.column_stack([x_m, y_m])
        self._intensity = intensity
        self.places = spread_places(self._position_m, places)
        self._index = {pixel: index for index, pixel in enumerate(self.places.tolist())}
        self._priors: dict[tuple[float, float], _Prior] = {}
        self._chosen: dict[int, Smoothness] = {0: TYPICAL}

    def choose(self, answers: Answers, is_swapped: bool) -> Comparison:
        """Return the next comparison. is_swapped: whether the pixel of the higher index comes first."""
        smoothness = self._choose_smoothness(answers)
        posterior, prior = self._fit(answers, smoothness), self._get_prior(smoothness)
        moved = prior.to_pixels @ posterior.covariance
        gain, spread = moved.T @ moved, posterior.covariance
        reduction = _contrast(gain) / (_expected_variance(smoothness.scale) + _contrast(spread))
        pair = np.unravel_index(int(np.triu(reduction, 1).argmax()), reduction.shape)
        first, second = (int(index) for index in (pair[::-1] if is_swapped else pair))
        centred = np.clip((prior.to_pixels @ posterior.mean)[self.places], -PRESENTED_MAX, PRESENTED_MAX)
        shown = np.round((self._intensity + BOTH_THRESHOLDS) * np.exp(-centred) - BOTH_THRESHOLDS, 4)
        return Comparison(int(self.places[first]), int(self.places[second]), float(shown[first]), float(shown[second]))

    def estimate(self, answers: Answers) -> Sensitivity:
        """Return sensitivity and uncertainty of every pixel."""
        grid = [Smoothness(*each) for each in product(LENGTHS, DEVIATIONS, SCALES)]
        fits = [(self._fit(answers, each), self._get_prior(each)) for each in grid]
        evidence = np.array([posterior.evidence for posterior, _ in fits])
        weight = np.exp(evidence - evidence.max())
        weight /= weight.sum()
        means = np.array([prior.to_pixels @ posterior.mean for posterior, prior in fits])
        variances = np.array(
            [
                prior.spread + np.einsum("pn,nm,pm->p", prior.to_pixels, posterior.covariance, prior.to_pixels)
                for posterior, prior in fits
            ]
        )
        mean = weight @ means
        variance = weight @ (variances + (means - mean) ** 2)
        return Sensitivity(np.exp(mean), np.exp(mean) * np.sqrt(variance))

    def _choose_smoothness(self, answers: Answers) -> Smoothness:
        """Return the most likely smoothness by the last multiple of REFIT_TRIALS answers, TYPICAL before."""
        count = len(answers) // REFIT_TRIALS * REFIT_TRIALS
        if count not in self._chosen:
            grid = (Smoothness(*each) for each in product(LENGTHS, DEVIATIONS, SCALES))
            self._chosen[count] = max(grid, key=lambda each: self._fit(answers[:count], each).evidence)
        return self._chosen[count]

    def _get_prior(self, smoothness: Smoothness) -> _Prior:
        key = smoothness[:2]
        if key not in self._priors:
            self._priors[key] = self._build_prior(smoothness)
        return self._priors[key]

    def _build_prior(self, smoothness: Smoothness) -> _Prior:
        square_m2 = np.sum((self._position_m[:, None] - self._position_m[self.places][None]) ** 2, axis=2)
        length_m, variance = smoothness.length * self._side_m, smoothness.deviation**2
        pixels = variance * np.exp(-0.5 * square_m2 / length_m**2)
        places = pixels[self.places] + NUGGET * variance * np.eye(len(self.places))
        to_pixels = np.linalg.solve(places, pixels.T).T
        spread = np.maximum(variance - np.einsum("pn,pn->p", to_pixels, pixels), 0.0)
        return _Prior(np.linalg.inv(places), _log_determinant(places), to_pixels - to_pixels.mean(axis=0), spread)

    @cached_property
    def _side_m(self) -> float:
        return float(np.ptp(self._position_m, axis=0).max())

    def _fit(self, answers: Answers, smoothness: Smoothness) -> Posterior:
        """Return the posterior after answers, by Newton's method with the expected curvature."""
        prior, count = self._get_prior(smoothness), len(self.places)
        design, offset, is_second = self._list_rows(answers)
        mean = np.zeros(count)
        for _ in range(STEPS_MAX):
            probability, slope = _respond((design @ mean + offset) / smoothness.scale)
            slope = slope / smoothness.scale
            score = slope * np.where(is_second, 1.0 / probability, -1.0 / (1.0 - probability))
            weight = slope**2 / (probability * (1.0 - probability))
            precision = prior.inverse + design.T @ (weight[:, None] * design)
            step = np.linalg.solve(precision, design.T @ score - prior.inverse @ mean)
            mean = mean + step
            if np.abs(step).max(initial=0.0) < STEP_MIN:
                break
        probability, _ = _respond((design @ mean + offset) / smoothness.scale)
        log_likelihood = float(np.log(np.where(is_second, probability, 1.0 - probability)).sum())
        evidence = log_likelihood - 0.5 * float(mean @ prior.inverse @ mean)
        evidence -= 0.5 * (prior.log_determinant + _log_determinant(precision))
        covariance: FloatArray = np.asarray(np.linalg.inv(precision), dtype=np.float64)
        return Posterior(mean, covariance, evidence)

    def _list_rows(self, answers: Answers) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return signs of the places [t, n], known differences [t], and answers [t] of trials."""
        design = np.zeros((len(answers), len(self.places)))
        offset, is_second = np.zeros(len(answers)), np.zeros(len(answers))
        for row, (comparison, answer) in enumerate(answers):
            design[row, self._index[comparison.second]] += 1.0
            design[row, self._index[comparison.first]] -= 1.0
            second, first = comparison.second_intensity, comparison.first_intensity
            offset[row] = np.log(second + BOTH_THRESHOLDS) - np.log(first + BOTH_THRESHOLDS)
            is_second[row] = answer
        return design, offset, np.asarray(is_second > 0.0)


def spread_places(position_m: FloatArray, count: int) -> IntArray:
    """Return pixels that are spread over a display [p, 2]: the middle one, then each farthest from those before."""
    distance_m = np.linalg.norm(position_m - position_m.mean(axis=0), axis=1)
    places = [int(distance_m.argmin())]
    nearest_m = np.linalg.norm(position_m - position_m[places[0]], axis=1)
    while len(places) < min(count, len(position_m)):
        places.append(int(nearest_m.argmax()))
        nearest_m = np.minimum(nearest_m, np.linalg.norm(position_m - position_m[places[-1]], axis=1))
    return np.array(sorted(places), dtype=np.int64)


def _respond(difference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the probability of the answer "second", and its slope, at a difference in units of the scale."""
    share = 1.0 / (1.0 + np.exp(-np.clip(difference, -50.0, 50.0)))
    return 0.5 * GUESSES + (1.0 - GUESSES) * share, (1.0 - GUESSES) * share * (1.0 - share)


def _expected_variance(scale: float) -> float:
    """Return the variance of a difference that one answer alone would leave, at equal sensations."""
    return (2.0 * scale / (1.0 - GUESSES)) ** 2


def _contrast(matrix: FloatArray) -> FloatArray:
    """Return the variance of the difference of each two variables of a covariance [n, n]."""
    own = np.diag(matrix)
    return np.asarray(own[:, None] + own[None, :] - 2.0 * matrix)


def _log_determinant(matrix: FloatArray) -> float:
    return float(np.linalg.slogdet(matrix)[1])
