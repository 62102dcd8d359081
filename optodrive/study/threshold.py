"""Thresholds: which level a trial takes, and the posterior of the threshold from the answers.

Theory of operation. A participant's probability of a correct answer at level x is a Weibull function,
chance + (1 - chance - lapse) (1 - exp(-(x / threshold)^slope)): at the threshold, 63 % of the way from chance to the
upper asymptote. One grid of thresholds, slopes and lapses with a prior that is uniform in the logarithm of threshold
and slope gives the posterior after any sequence of answers, by any choice of levels; its median is the estimate, and
its central 95 % the interval. The grid goes beyond the levels by a factor of MARGIN, and holds lapses above 5 % with a
small probability, so that answers which do not fit the design widen the interval; what then makes an estimate doubtful
is flagged by name, and what the levels do not determine is no number. Where the participant chooses the guess rate
(yes/no), it is a further dimension of the grid. Three procedures choose levels:

- constant stimuli: every level as often, in an order drawn beforehand
- staircase (1 up, 2 down; Levitt 1971): a level down after two correct answers in a row, a level up after an error
- QUEST+ (Watson 2017): the level whose answer is expected to leave the posterior with the smallest entropy

The grid is bounded by the design: at most GRID_MAX parameter points, times the guess rates of a yes/no task, and as
many levels as the study states. So every trial costs the same, below a millisecond or a few.
"""

import random
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
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
DIFFERENCE_SLOPES = (0.75, 3.0)
"""Slopes over a difference of two intervals: 1.25 times the exponent of d', assumed to be 0.6 to 2.4."""
LAPSE_RANGE = (0.0, 0.05)
"""Lapses of a participant who attends."""
LAPSES = ((0.0, 0.31), (0.025, 0.31), (0.05, 0.31), (0.1, 0.04), (0.2, 0.02), (0.35, 0.01))
"""Lapses of the grid, and their prior probabilities."""
GRID_MAX = THRESHOLDS * SLOPES * len(LAPSES)
GUESSES = ((0.02, 0.25), (0.05, 0.2), (0.1, 0.2), (0.2, 0.2), (0.35, 0.15))
"""Guess rates of the grid where the participant chooses it, and their prior probabilities."""
GUESSING_MAX = 0.01
"""Largest probability by guessing of so few correct answers, at which they count as fewer than by guessing."""
LIKELIHOOD_RATIO = 9.21
"""Twice the logarithm of a likelihood ratio that chance alone exceeds once in 100 (χ² of two parameters)."""
EXCHANGED_RATIO = 13.8
"""As LIKELIHOOD_RATIO, once in 1000."""
LAPSING_MIN = 0.2
"""Smallest probability of more lapses than LAPSE_RANGE at which they are named; 0.07 before the first answer."""
CORRECT_MAX = 1.0 - 1e-9
"""Largest probability of a correct answer, which no error contradicts altogether."""
TAIL = 0.025


class Flag(StrEnum):
    """Why answers do not determine a threshold, or not as well as its interval would say."""

    ALL_CORRECT = "all-correct"
    ALL_WRONG = "all-wrong"
    EXCHANGED_KEYS = "exchanged-keys"
    GUESSING = "guessing"
    LAPSES = "lapses"
    BELOW_LEVELS = "below-levels"
    ABOVE_LEVELS = "above-levels"

    @property
    def explanation(self) -> str:
        """One sentence for a person."""
        return EXPLANATIONS[self]


EXPLANATIONS = {
    Flag.ALL_CORRECT: "every answer is correct, so the levels do not reach down to the threshold",
    Flag.ALL_WRONG: "every answer is wrong: exchanged keys, or no stimulus was felt?",
    Flag.EXCHANGED_KEYS: "fewer answers are correct than by guessing: exchanged keys?",
    Flag.GUESSING: "the answers do not depend on the level: guesses, or every level lies below the threshold",
    Flag.LAPSES: f"more than {100 * LAPSE_RANGE[1]:g} % of the answers at high levels seem to be lapses",
    Flag.BELOW_LEVELS: "the threshold may lie below the tested levels, where the study does not measure it",
    Flag.ABOVE_LEVELS: "the threshold may lie above the tested levels, where the study does not measure it",
}


class ThresholdEstimate(NamedTuple):
    """Threshold with its 95 % interval, in the unit of the levels.

    None for what the answers do not determine. Without a threshold, `high` alone bounds it from above, `low` alone
    from below. flags: why it may not be the participant's
    """

    threshold: float | None
    low: float | None
    high: float | None
    flags: tuple[Flag, ...] = ()

    def __str__(self) -> str:
        if self.threshold is None:
            bounds = [f"{word} {x:.3g}" for word, x in (("above", self.low), ("below", self.high)) if x is not None]
            return bounds[0] if bounds else "not determined"
        low, high = ("the levels" if end is None else f"{end:.3g}" for end in (self.low, self.high))
        words = f"95 % interval {'below ' if self.low is None else ''}{low} to {'above ' if self.high is None else ''}"
        return f"{self.threshold:.3g} ({words}{high})"


@dataclass(frozen=True)
class ThresholdModel:
    """Posterior of a threshold over a grid that spans the levels.

    levels: increasing and positive; chance: probability of a correct answer by guessing, None if the participant
    chooses it, as in a yes/no task; slope_range: of the grid
    """

    levels: tuple[float, ...]
    chance: float | None
    slope_range: tuple[float, float] = SLOPE_RANGE

    @cached_property
    def log_thresholds(self) -> FloatArray:
        """Natural logarithms of the grid's thresholds, [t]."""
        return np.linspace(np.log(self.levels[0] / MARGIN), np.log(self.levels[-1] * MARGIN), THRESHOLDS)

    @cached_property
    def _habits(self) -> FloatArray:
        """Guess rate, lapses and prior probability of each habit of a participant, [h, 3]."""
        guesses = ((self.chance, 1.0),) if self.chance is not None else GUESSES
        rows = [(guess, lapse, p * q) for guess, p in guesses for lapse, q in LAPSES]
        return np.array(rows)

    @cached_property
    def correct(self) -> FloatArray:
        """Probability of a correct answer at each level and grid point, [l, t × s × h]."""
        return self._compute_shares(self.levels)

    def _compute_shares(self, levels: Sequence[float]) -> FloatArray:
        slopes, (guesses, lapses, _) = np.geomspace(*self.slope_range, SLOPES), self._habits.T
        log_level = np.log(levels)[:, None, None, None]
        drive = np.exp(slopes[:, None] * (log_level - self.log_thresholds[:, None, None]))
        share = guesses + (1.0 - guesses - lapses) * -np.expm1(-drive)
        return np.asarray(np.minimum(share, CORRECT_MAX).reshape(len(levels), -1), dtype=np.float64)

    def compute_curve(self, answered: Answered, levels: Sequence[float]) -> FloatArray:
        """Return the expected share of correct answers at levels [l] after answers."""
        return np.asarray(self._compute_shares(levels) @ self.compute_posterior(answered), dtype=np.float64)

    @cached_property
    def _outcomes(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Return p and p log p of a correct and of a wrong answer, [l, t × s × h] each."""
        return tuple((p, np.asarray(p * np.log(p))) for p in (self.correct, 1.0 - self.correct))

    def _compute_log_likelihood(self, answered: Answered) -> FloatArray:
        """Return the logarithm of the probability of answers at each grid point, [t × s × h]."""
        counts = np.zeros((2, len(self.levels)))
        for level, is_correct in answered:
            counts[int(is_correct), level] += 1.0
        return np.asarray(counts[1] @ np.log(self.correct) + counts[0] @ np.log1p(-self.correct), dtype=np.float64)

    def compute_posterior(self, answered: Answered) -> FloatArray:
        """Return the probability of each grid point after answers, [t × s × h]."""
        log_prior = np.tile(np.log(self._habits[:, 2]), THRESHOLDS * SLOPES)
        log_posterior = log_prior + self._compute_log_likelihood(answered)
        weight = np.exp(log_posterior - log_posterior.max())
        return np.asarray(weight / weight.sum(), dtype=np.float64)

    def estimate(self, answered: Answered) -> ThresholdEstimate:
        """Return the threshold and its central 95 % interval after answers.

        It is a number only within the levels that were tested, and an end of the interval only within all levels.
        """
        if not answered:
            return ThresholdEstimate(None, None, None)
        flag = self._find_misfit(answered)
        if flag is Flag.EXCHANGED_KEYS or (flag is Flag.ALL_WRONG and self.chance is not None):
            return ThresholdEstimate(None, None, None, (flag,))
        posterior = self.compute_posterior(answered).reshape(THRESHOLDS, SLOPES, -1)
        marginal = posterior.sum(axis=(1, 2))
        # Each grid point stands for a cell around it, in which the probability is even.
        step = float(self.log_thresholds[1] - self.log_thresholds[0])
        edges = np.append(self.log_thresholds - 0.5 * step, self.log_thresholds[-1] + 0.5 * step)
        cumulated = np.append(0.0, np.cumsum(marginal))
        low, median, high = (float(x) for x in np.exp(np.interp([TAIL, 0.5, 1.0 - TAIL], cumulated, edges)))
        tested = [self.levels[level] for level, _ in answered]
        # A bound lies within the tested levels, too.
        below = ThresholdEstimate(None, None, max(high, min(tested)) if high <= max(tested) else None)
        above = ThresholdEstimate(None, min(low, max(tested)) if low >= min(tested) else None, None)
        if flag is not None:
            known = {Flag.ALL_CORRECT: below, Flag.ALL_WRONG: above, Flag.GUESSING: above}[flag]
            is_stated = self.chance is not None or flag is Flag.ALL_WRONG
            return known._replace(flags=(flag,)) if is_stated else ThresholdEstimate(None, None, None, (flag,))
        lapsing = float(posterior[:, :, self._habits[:, 1] > LAPSE_RANGE[1]].sum())
        flags: tuple[Flag, ...] = (Flag.LAPSES,) if lapsing > LAPSING_MIN else ()
        if low < self.levels[0] or median < min(tested):
            flags += (Flag.BELOW_LEVELS,)
        if high > self.levels[-1] or median > max(tested):
            flags += (Flag.ABOVE_LEVELS,)
        if not min(tested) <= median <= max(tested):
            return (below if median < min(tested) else above)._replace(flags=flags)
        return ThresholdEstimate(
            median, low if low >= self.levels[0] else None, high if high <= self.levels[-1] else None, flags
        )

    def _find_misfit(self, answered: Answered) -> Flag | None:
        """Return why answers have no threshold, None if they do."""
        correct, trials = sum(is_correct for _, is_correct in answered), len(answered)
        if correct in (0, trials):
            return Flag.ALL_CORRECT if correct else Flag.ALL_WRONG
        if self.chance is not None and sum_binomial(correct, trials, self.chance) < GUESSING_MAX:
            return Flag.EXCHANGED_KEYS
        guess = correct / trials if self.chance is None else self.chance
        guessing = correct * log(guess) + (trials - correct) * log(1.0 - guess)
        if 2.0 * (float(self._compute_log_likelihood(answered).max()) - guessing) > LIKELIHOOD_RATIO:
            return None
        # Fewer answers are correct at higher levels.
        exchanged = [(level, not is_correct) for level, is_correct in answered]
        falling = ThresholdModel(self.levels, None, self.slope_range)._compute_log_likelihood(exchanged)
        return Flag.EXCHANGED_KEYS if 2.0 * (float(falling.max()) - guessing) > EXCHANGED_RATIO else Flag.GUESSING

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
