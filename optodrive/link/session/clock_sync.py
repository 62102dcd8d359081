"""Synchronisation with the clock of the board by the narrowest of the recent exchanges, and errors of pulse times.

Every exchange brackets a board tick between its request and its reply.
"""

import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import floor
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray


class ClockReading(NamedTuple):
    """The same moment on the board's clock, the host's monotonic clock (CLOCK_MONOTONIC) and in Unix time, s."""

    board_s: float
    monotonic_s: float
    unix_s: float

    def convert(self, board_s: float) -> "ClockReading":
        """Return another moment of the board's clock on all three. Its error grows with the distance and the drift."""
        elapsed_s = board_s - self.board_s
        return ClockReading(board_s, self.monotonic_s + elapsed_s, self.unix_s + elapsed_s)


CLOCK_SPAN_S = 16.0
"""Time over which the clocks are compared."""
CLOCK_INTERVAL_S = 1.0
PENDING_MAX = 64
WIDTH_MIN_S = 1e-6
WANDER_MAX = 2e-6
"""Largest change of a crystal's relative rate over the recent exchanges."""
RATE_ERROR_MAX = 5e-3
"""Relative error of its rate beyond which a clock is broken, not slow."""
DRIFT_MAX = 2e-4
"""Maximum relative drift of two crystals. A bracket widens at this rate with age."""


class ClockFit(NamedTuple):
    """Straight line through recent exchanges: at host time host_s the board's clock reads board_s, and runs at rate.

    uncertainty_s: bound on the error of board_s: half the width of an exchange, and what the clocks drift since then
    """

    host_s: float
    board_s: float
    rate: float
    uncertainty_s: float

    def to_board_s(self, host_s: float) -> float:
        """Return the board time at a host time, s."""
        return self.board_s + self.rate * (host_s - self.host_s)

    def to_host_s(self, board_s: float) -> float:
        """Return the host time at a board time, s."""
        return self.host_s + (board_s - self.board_s) / self.rate


class _FittedLine(NamedTuple):
    """A fit as of its last exchange.

    samples: those it was fitted to; drift: bound on the error of its rate
    narrowest: exchange that bounds the error of the fit, round trip and middle, s
    """

    samples: tuple[tuple[float, float, float], ...]
    fit: ClockFit
    drift: float
    narrowest: tuple[float, float]


class ClockSync:
    """Map from host time to board time (ticks / tick_hz). One thread adds samples, any thread may read.

    interval_s: of each interval the narrowest exchange counts
    """

    def __init__(self, interval_s: float = CLOCK_INTERVAL_S) -> None:
        self._interval_s = interval_s
        self._samples_max = round(CLOCK_SPAN_S / interval_s)
        self._request_s: dict[int, float] = {}
        # An immutable tuple, because another thread may be reading it.
        self._samples: tuple[tuple[float, float, float], ...] = ()
        self._best: tuple[float, float] | None = None
        self._line: _FittedLine | None = None

    def start_exchange(self, request_s: float) -> int:
        """Record a request sent at request_s and return its random stamp."""
        # Replies were lost: their stamps would pile up, and all are older than any reply that may come.
        if len(self._request_s) > PENDING_MAX:
            self._request_s.clear()
        # Random: a counter would repeat in the next session, whose board may still answer a request of this one.
        stamp = secrets.randbits(32)
        self._request_s[stamp] = request_s
        return stamp

    def finish_exchange(self, stamp: int, reply_s: float, board_s: float) -> float | None:
        """Add the sample of a reply received at reply_s, and return its round trip, s. Ignore an unknown stamp.

        board_s: board clock in the reply
        """
        request_s = self._request_s.pop(stamp, None)
        if request_s is None:
            return None
        sample, samples = (reply_s - request_s, (request_s + reply_s) / 2, board_s), self._samples
        # One sample per interval, the narrowest: frequent exchanges must not push out the time over which drift shows.
        if not samples or self._number_interval(samples[-1]) != self._number_interval(sample):
            self._samples = (*samples[1 - self._samples_max :], sample)
        elif sample[0] < samples[-1][0]:
            self._samples = (*samples[:-1], sample)
        # All brackets widen alike, so that the narrowest is the same at all times.
        self._best = min(self._samples, key=lambda each: each[0] - DRIFT_MAX * each[1])[1:]
        return sample[0]

    def compute_contradiction_s(self, stamp: int, reply_s: float, board_s: float) -> float:
        """Return how far a reply lies outside the range that the latest exchange permits, s, 0 for an unknown stamp."""
        request_s = self._request_s.get(stamp)
        if request_s is None or not self._samples:
            return 0.0
        width_s, midpoint_s, last_board_s = self._samples[-1]
        elapsed_s = (request_s + reply_s) / 2 - midpoint_s
        # Each exchange brackets the tick, so both may be off by half their widths at once.
        permitted_s = 0.5 * (width_s + reply_s - request_s) + RATE_ERROR_MAX * abs(elapsed_s)
        return max(0.0, abs(board_s - last_board_s - elapsed_s) - permitted_s)

    def _number_interval(self, sample: tuple[float, float, float]) -> int:
        return floor(sample[1] / self._interval_s)

    @property
    def is_synchronised(self) -> bool:
        """Whether at least one exchange has completed."""
        return bool(self._samples)

    @property
    def round_trip_s(self) -> float | None:
        """Shortest round trip of the recent samples, s, None without any."""
        return min((sample[0] for sample in self._samples), default=None)

    @property
    def best_sample(self) -> tuple[float, float] | None:
        """Host time and board time, s, of the exchange whose bracket is the narrowest now, or None before the first."""
        return self._best

    def fit(self, host_s: float) -> ClockFit | None:
        """Fit the line to the recent exchanges, None before the first.

        An exchange counts by the inverse square of its width. With few of them, the rate stays near 1.
        """
        samples, line = self._samples, self._line
        if not samples:
            return None
        if line is None or line.samples is not samples:
            line = self._line = _fit_line(samples)
        width_s, midpoint_s = line.narrowest
        return line.fit._replace(uncertainty_s=width_s / 2 + line.drift * (host_s - midpoint_s))

    def board_s(self, host_s: float) -> float:
        """Return the board time at host time host_s, s, or 0 before the first exchange."""
        if self._best is None:
            return 0.0
        midpoint_s, board_s = self._best
        return board_s + (host_s - midpoint_s)


def _fit_line(samples: tuple[tuple[float, float, float], ...]) -> _FittedLine:
    """Fit the line, an exchange by the inverse square of its width."""
    weights = [1.0 / max(width_s, WIDTH_MIN_S) ** 2 for width_s, _, _ in samples]
    total = sum(weights)
    mean_s = sum(w * midpoint_s for w, (_, midpoint_s, _) in zip(weights, samples, strict=True)) / total
    ahead_s = [board_s - midpoint_s for _, midpoint_s, board_s in samples]
    mean_ahead_s = sum(w * each for w, each in zip(weights, ahead_s, strict=True)) / total
    spread = covariance = 0.0
    for w, (_, midpoint_s, _), each in zip(weights, samples, ahead_s, strict=True):
        spread += w * (midpoint_s - mean_s) ** 2
        covariance += w * (midpoint_s - mean_s) * (each - mean_ahead_s)
    # A ridge: with few exchanges the rate stays near 1 instead of following their errors.
    rate = 1.0 + covariance / (spread + 1.0 / DRIFT_MAX**2)
    # The line is stated at its last exchange, where little has to be extrapolated.
    at_s = samples[-1][1]
    drift = _bound_drift(samples)
    width_s, midpoint_s, _ = min(samples, key=lambda sample: sample[0] / 2 - drift * sample[1])
    fit = ClockFit(at_s, mean_s + mean_ahead_s + rate * (at_s - mean_s), rate, width_s / 2)
    return _FittedLine(samples, fit, drift, (width_s, midpoint_s))


def _bound_drift(samples: Sequence[tuple[float, float, float]]) -> float:
    """Return a bound on the error of the rate: both ends of a line lie within the exchanges of either half."""
    half = len(samples) // 2
    if not half:
        return DRIFT_MAX
    first, last = (min(each, key=lambda sample: sample[0]) for each in (samples[:half], samples[half:]))
    span_s = max(last[1] - first[1], WIDTH_MIN_S)
    # Never better than the wander: a line through old exchanges does not show what the crystal does now.
    return min(DRIFT_MAX, 0.5 * (first[0] + last[0]) / span_s + WANDER_MAX)


@dataclass(frozen=True)
class TimingError:
    """Executed start − planned start of a plan's pulses, both from the plan's zero on the board's clock, s.

    start_delay_s: error of the first pulse, which shifts the whole plan
    median_s: median error
    max_abs_s: signed error of largest magnitude
    drift_ppm: slope over planned time of the error without the start delay, 0 if all pulses start at one time
    pulses: number of executed pulses that were compared
    """

    pulses: int
    start_delay_s: float
    median_s: float
    max_abs_s: float
    drift_ppm: float


def compute_timing_error(planned_s: FloatArray, executed_s: FloatArray) -> TimingError | None:
    """Compute the error from planned and executed starts of the same pulses, [n] each. Return None without pulses."""
    if not len(planned_s):
        return None
    error_s = executed_s - planned_s
    residual_s, centred_s = error_s - error_s[0], planned_s - planned_s.mean()
    spread_s2 = float(centred_s @ centred_s)
    return TimingError(
        pulses=len(error_s),
        start_delay_s=float(error_s[0]),
        median_s=float(np.median(error_s)),
        max_abs_s=float(error_s[np.abs(error_s).argmax()]),
        drift_ppm=1e6 * float(centred_s @ residual_s) / spread_s2 if spread_s2 else 0.0,
    )


class TimingTotals:
    """Totals over all plans.

    worst: number of pulses, and the error of largest magnitude of every kind; None before the first pulse
    """

    def __init__(self) -> None:
        self.worst: TimingError | None = None

    def add(self, error: TimingError) -> None:
        """Add the error of a plan."""
        previous = self.worst
        if previous is None:
            self.worst = error
            return
        worst = {
            name: max(value, getattr(previous, name), key=abs)
            for name, value in asdict(error).items()
            if name != "pulses"
        }
        self.worst = TimingError(pulses=previous.pulses + error.pulses, **worst)
