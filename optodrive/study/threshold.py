"""Thresholds: which level a trial takes, and the posterior of the threshold from the answers.

Theory of operation. A participant's probability of a correct answer at level x is a Weibull function,
chance + (1 - chance - lapse) (1 - exp(-(x / threshold)^slope)): at the threshold, 63 % of the way from chance to the
upper asymptote. One grid of thresholds, slopes and lapses with a uniform prior (in the logarithm of threshold and
slope) gives the posterior after any sequence of answers, by any choice of levels; its mean in the logarithm is the
estimate, and its central 95 % the interval. Three procedures choose levels:

- constant stimuli: every level as often, in an order drawn beforehand
- staircase (1 up, 2 down; Levitt 1971): a level down after two correct answers in a row, a level up after an error
- QUEST+ (Watson 2017): the level whose answer is expected to leave the posterior with the smallest entropy

The grid is bounded by the design: at most GRID_MAX parameter points, and as many levels as the study states. So every
trial costs the same, below a millisecond or a few.
"""

import random
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray

Procedure = Literal["constant", "staircase", "quest-plus"]
Answered = Sequence[tuple[int, bool]]
"""Level, as its index, and whether the answer was correct, of each trial so far."""

THRESHOLDS, SLOPES, LAPSES = 81, 7, 3
GRID_MAX = THRESHOLDS * SLOPES * LAPSES
SLOPE_RANGE = (1.5, 6.0)
LAPSE_RANGE = (0.0, 0.05)
CORRECT_MAX = 1.0 - 1e-9
"""Largest probability of a correct answer, which no error contradicts altogether."""
TAIL = 0.025
STAIRCASE_DOWN = 2


class ThresholdEstimate(NamedTuple):
    """Threshold with its 95 % interval, in the unit of the levels."""

    threshold: float
    low: float
    high: float


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
        return np.linspace(np.log(self.levels[0]), np.log(self.levels[-1]), THRESHOLDS)

    @cached_property
    def correct(self) -> FloatArray:
        """Probability of a correct answer at each level and grid point, [l, t × s × λ]."""
        slopes, lapses = np.geomspace(*SLOPE_RANGE, SLOPES), np.linspace(*LAPSE_RANGE, LAPSES)
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
        log_likelihood = np.zeros(self.correct.shape[1])
        for level, is_correct in answered:
            probability = self.correct[level]
            log_likelihood += np.log(probability if is_correct else 1.0 - probability)
        weight = np.exp(log_likelihood - log_likelihood.max())
        return np.asarray(weight / weight.sum(), dtype=np.float64)

    def estimate(self, answered: Answered) -> ThresholdEstimate:
        """Return the threshold and its central 95 % interval after answers."""
        marginal = self.compute_posterior(answered).reshape(THRESHOLDS, -1).sum(axis=1)
        # Each grid point stands for a cell around it, in which the probability is even.
        step = float(self.log_thresholds[1] - self.log_thresholds[0])
        edges = np.append(self.log_thresholds - 0.5 * step, self.log_thresholds[-1] + 0.5 * step)
        cumulated = np.append(0.0, np.cumsum(marginal))
        low, high = np.interp([TAIL, 1.0 - TAIL], cumulated, edges)
        return ThresholdEstimate(*(float(np.exp(value)) for value in (marginal @ self.log_thresholds, low, high)))

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


def draw_constant_levels(level_count: int, trials: int, seed: str) -> list[int]:
    """Return an order in which every level comes as often, to within one trial."""
    order = [index % level_count for index in range(trials)]
    random.Random(seed).shuffle(order)
    return order


def select_staircase_level(level_count: int, answered: Answered) -> int:
    """Return the next level of a staircase with one up and two down that starts at the highest level.

    Until its first error it goes down after each correct answer, which brings it near the threshold.
    """
    level, run, has_erred = level_count - 1, 0, False
    for _, is_correct in answered:
        if not is_correct:
            level, run, has_erred = min(level + 1, level_count - 1), 0, True
            continue
        run += 1
        if run == STAIRCASE_DOWN or not has_erred:
            level, run = max(level - 1, 0), 0
    return level
