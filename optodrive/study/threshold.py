"""Thresholds: which level a trial takes, and the posterior of the threshold from the answers.

Theory of operation. A participant's probability of a correct answer at level x is a Weibull function,
chance + (1 - chance - lapse) (1 - exp(-(x / threshold)^slope)): at the threshold, 63 % of the way from chance to the
upper asymptote. One grid of thresholds, slopes and lapses with a prior that is uniform in the logarithm of threshold
and slope gives the posterior after any sequence of answers, by any choice of levels; its median is the estimate, and
its central 95 % the interval. The grid goes beyond the levels by a factor of MARGIN, and holds lapses above 5 % with a
small probability, so that answers which do not fit the design widen the interval; what then makes an estimate doubtful
is said in words. Three procedures choose levels:

- constant stimuli: every level as often, in an order drawn beforehand
- staircase (1 up, 2 down; Levitt 1971): a level down after two correct answers in a row, a level up after an error
- QUEST+ (Watson 2017): the level whose answer is expected to leave the posterior with the smallest entropy

The grid is bounded by the design: at most GRID_MAX parameter points, and as many levels as the study states. So every
trial costs the same, below a millisecond or a few.
"""

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import exp, lgamma, log
from typing import Literal, NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray

Procedure = Literal["constant", "staircase", "quest-plus"]
Answered = Sequence[tuple[int, bool]]
"""Level, as its index, and whether the answer was correct, of each trial so far."""

THRESHOLDS, SLOPES = 121, 7
MARGIN = 4.0
"""Factor by which the grid of thresholds goes beyond the levels."""
SLOPE_RANGE = (1.5, 6.0)
LAPSE_RANGE = (0.0, 0.05)
"""Lapses of a participant who attends."""
LAPSES = ((0.0, 0.31), (0.025, 0.31), (0.05, 0.31), (0.1, 0.04), (0.2, 0.02), (0.35, 0.01))
"""Lapses of the grid, and their prior probabilities."""
GRID_MAX = THRESHOLDS * SLOPES * len(LAPSES)
GUESSING_MAX = 0.01
"""Largest probability by guessing of so few correct answers, at which they count as fewer than by guessing."""
CORRECT_MAX = 1.0 - 1e-9
"""Largest probability of a correct answer, which no error contradicts altogether."""
TAIL = 0.025


class ThresholdEstimate(NamedTuple):
    """Threshold with its 95 % interval, in the unit of the levels. doubts: why it may not be the participant's."""

    threshold: float
    low: float
    high: float
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class ThresholdModel:
    """Posterior of a threshold over a grid that spans the levels.

    levels: increasing and positive; chance: probability of a correct answer by guessing
    """

    levels: tuple[float, ...]
    chance: float

    @cached_property
    def log_thresholds(self) -> FloatArray:
        """Natural logarithms of the grid's thresholds, [t]."""
        return np.linspace(np.log(self.levels[0] / MARGIN), np.log(self.levels[-1] * MARGIN), THRESHOLDS)

    @cached_property
    def correct(self) -> FloatArray:
        """Probability of a correct answer at each level and grid point, [l, t × s × λ]."""
        slopes, lapses = np.geomspace(*SLOPE_RANGE, SLOPES), np.array(LAPSES)[:, 0]
        log_level = np.log(self.levels)[:, None, None, None]
        drive = np.exp(slopes[:, None] * (log_level - self.log_thresholds[:, None, None]))
        share = self.chance + (1.0 - self.chance - lapses) * -np.expm1(-drive)
        return np.asarray(np.minimum(share, CORRECT_MAX).reshape(len(self.levels), -1), dtype=np.float64)

    @cached_property
    def _outcomes(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Return p and p log p of a correct and of a wrong answer, [l, t × s × λ] each."""
        return tuple((p, np.asarray(p * np.log(p))) for p in (self.correct, 1.0 - self.correct))

    def compute_posterior(self, answered: Answered) -> FloatArray:
        """Return the probability of each grid point after answers, [t × s × λ]."""
        log_likelihood = np.tile(np.log(np.array(LAPSES)[:, 1]), THRESHOLDS * SLOPES)
        for level, is_correct in answered:
            probability = self.correct[level]
            log_likelihood += np.log(probability if is_correct else 1.0 - probability)
        weight = np.exp(log_likelihood - log_likelihood.max())
        return np.asarray(weight / weight.sum(), dtype=np.float64)

    def estimate(self, answered: Answered) -> ThresholdEstimate:
        """Return the threshold and its central 95 % interval after answers."""
        posterior = self.compute_posterior(answered).reshape(THRESHOLDS, SLOPES, len(LAPSES))
        marginal = posterior.sum(axis=(1, 2))
        # Each grid point stands for a cell around it, in which the probability is even.
        step = float(self.log_thresholds[1] - self.log_thresholds[0])
        edges = np.append(self.log_thresholds - 0.5 * step, self.log_thresholds[-1] + 0.5 * step)
        cumulated = np.append(0.0, np.cumsum(marginal))
        low, median, high = np.exp(np.interp([TAIL, 0.5, 1.0 - TAIL], cumulated, edges))
        found = ThresholdEstimate(float(median), float(low), float(high))
        lapsing = float(posterior[:, :, np.array(LAPSES)[:, 0] > LAPSE_RANGE[1]].sum())
        return found._replace(doubts=tuple(self._list_doubts(found, lapsing, answered)))

    def _list_doubts(self, found: ThresholdEstimate, lapsing: float, answered: Answered) -> Iterator[str]:
        """Yield the reasons to doubt an estimate.

        lapsing: posterior probability of more lapses than LAPSE_RANGE
        """
        lowest, highest = self.levels[0], self.levels[-1]
        if found.low < lowest:
            yield f"it may lie below the lowest level, {lowest:g}; the study does not measure it there"
        if found.high > highest:
            yield f"it may lie above the highest level, {highest:g}; the study does not measure it there"
        correct, trials = sum(is_correct for _, is_correct in answered), len(answered)
        if sum_binomial(correct, trials, self.chance) < GUESSING_MAX:
            yield f"{correct} of {trials} answers are correct, fewer than by guessing: exchanged keys?"
        elif lapsing > 0.5:
            yield f"more than {100 * LAPSE_RANGE[1]:g} % of the answers at high levels seem to be guesses"

    def select_informative_level(self, answered: Answered) -> int:
        """Return the level whose answer leaves the smallest expected entropy, the lowest of equal ones."""
        posterior = self.compute_posterior(answered)
        own = posterior * np.log(np.maximum(posterior, np.finfo(float).tiny))
        expected = np.zeros(len(self.levels))
        for share, share_log_share in self._outcomes:
            # The entropy of the joint distribution of answer and point, less that of the answer.
            total = share @ posterior
            expected += total * np.log(total) - share_log_share @ posterior - share @ own
        return int(np.argmin(expected))


def sum_binomial(successes: int, trials: int, probability: float) -> float:
    """Return the probability of at most this number of successes."""
    return sum(
        exp(
            lgamma(trials + 1)
            - lgamma(k + 1)
            - lgamma(trials - k + 1)
            + k * log(probability)
            + (trials - k) * log(1.0 - probability)
        )
        for k in range(successes + 1)
    )


def draw_constant_levels(level_count: int, trials: int, seed: str) -> list[int]:
    """Return an order in which every level comes as often, to within one trial."""
    order = [index % level_count for index in range(trials)]
    random.Random(seed).shuffle(order)
    return order


def select_staircase_level(level_count: int, answered: Answered, down: int = 2) -> int:
    """Return the next level of a staircase with one up and `down` down that starts at the highest level.

    Until its first error it goes down after each correct answer, which brings it near the threshold.
    """
    level, run, has_erred = level_count - 1, 0, False
    for _, is_correct in answered:
        if not is_correct:
            level, run, has_erred = min(level + 1, level_count - 1), 0, True
            continue
        run += 1
        if run == down or not has_erred:
            level, run = max(level - 1, 0), 0
    return level
