"""Smoothing: a program averages each sample of a signal with those before and after it."""

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter, describe_signals
from optodrive.physics.signal_filters import low_pass_both_ways, moving_mean
from optodrive.physics.term import BySignal, Term, TermValues, build_signal_parameters

SIGNALS = BySignal._fields
STARTS_S = (1e-3, 5e-3, 2e-2)
FORMS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 1.0), (0.0, 0.5, 1.0))
"""Tails, lateness and whether the width is in samples, from which a search begins."""
SAME_SPREAD = 24.0**-0.5
"""Time constant of a filter run both ways that spreads an edge as far as a moving mean of unit width."""
UNIT_INTERVAL_S = 1e-3


class Smoothing(Term):
    """A moving mean over the width, or with tails = 1 a low-pass run both ways as wide, late by late · width.

    With by_samples = 1, the width is that at one sample per millisecond, and a mean over as many samples elsewhere.
    """

    key = "smoothing"
    label = "a signal was smoothed before it was recorded"
    parameters = (
        *build_signal_parameters("s", 5e-3, 0.0, 0.1, "moving means and filters of loggers, to 50 ms", SIGNALS[:3]),
        TermParameter("tails", "1", 0.0, 0.0, 1.0, "0 moving mean, 1 filter run both ways", (0.0, 1.0), True),
        TermParameter("late", "1", 0.0, 0.0, 0.5, "0 centred, 0.5 mean of the last samples", (0.0, 0.5), True),
        TermParameter("by_samples", "1", 0.0, 0.0, 1.0, "0 width in time, 1 in samples", (0.0, 1.0), True),
    )
    cannot_add_heat = True
    is_fast = True
    signature = "edges that begin before the light does, or are rounded in one signal alone"
    remedy = "record again without averaging or filter."

    def record(self, values: TermValues, signal: str, t_s: FloatArray, value: FloatArray) -> FloatArray:
        """Return the smoothed signal, [n]."""
        width_s, tails = values.get(signal, 0.0), values["tails"]
        if width_s <= 0.0 or len(t_s) < 2:
            return value
        if values["by_samples"] > 0.5:
            width_s *= float(np.median(np.diff(t_s))) / UNIT_INTERVAL_S
        late_s = values["late"] * width_s
        mean = moving_mean(t_s, value, width_s, late_s) if tails < 1.0 else value
        if tails <= 0.0:
            return mean
        both = np.interp(t_s - late_s, t_s, low_pass_both_ways(t_s, value, SAME_SPREAD * width_s))
        return np.asarray(mean + tails * (both - mean))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one width for all signals, and one of each signal alone where there are several."""
        return [
            Hypothesis(
                self.key,
                f"{self.key} of {describe_signals(names)}",
                tuple(
                    dict.fromkeys(SIGNALS[:3], 0.0) | dict.fromkeys(names, width_s) | form
                    for width_s in STARTS_S
                    for form in (dict(zip(("tails", "late", "by_samples"), numbers, strict=True)) for numbers in FORMS)
                ),
                (self.free(*names), self.free("tails"), self.free("late")),
            )
            for names in scope.list_signal_sets(SIGNALS[:3])
        ]


TERM = Smoothing()
