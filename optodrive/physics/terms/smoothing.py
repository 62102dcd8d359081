"""Smoothing: a program averages each sample of a signal with those before and after it."""

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter, describe_signals
from optodrive.physics.signal_filters import low_pass_both_ways, moving_mean
from optodrive.physics.term import BySignal, Term, TermValues

SIGNALS = BySignal._fields
STARTS_S = (1e-3, 5e-3, 2e-2)
SAME_SPREAD = 24.0**-0.5
"""Time constant of a filter run both ways that spreads an edge as far as a moving mean of unit width."""


class Smoothing(Term):
    """A moving mean over the width, or with tails = 1 a low-pass run both ways as wide, late by late · width."""

    key = "smoothing"
    label = "a signal was smoothed before it was recorded"
    parameters = (
        *(
            TermParameter(name, "s", 5e-3, 0.0, 0.1, "moving means and filters of loggers, to 50 ms", neutral=0.0)
            for name in SIGNALS[:3]
        ),
        TermParameter("tails", "1", 0.0, 0.0, 1.0, "0 moving mean, 1 filter run both ways", (0.0, 1.0), True),
        TermParameter("late", "1", 0.0, 0.0, 0.5, "0 centred, 0.5 mean of the last samples", (0.0, 0.5), True),
    )
    cannot_add_heat = True
    is_fast = True
    signature = "edges that begin before the light does, or are rounded in one signal alone"
    remedy = "record again without averaging or filter."

    def signal_delays(self, values: TermValues) -> BySignal:
        """Return the delay of a mean of past samples."""
        return BySignal(*(values[name] * values["late"] for name in SIGNALS[:3]))

    def record(self, values: TermValues, signal: str, t_s: FloatArray, value: FloatArray) -> FloatArray:
        """Return the smoothed signal, [n]."""
        width_s, tails = values.get(signal, 0.0), values["tails"]
        if width_s <= 0.0:
            return value
        mean = moving_mean(t_s, value, width_s) if tails < 1.0 else value
        return np.asarray(
            mean if tails <= 0.0 else mean + tails * (low_pass_both_ways(t_s, value, SAME_SPREAD * width_s) - mean)
        )

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one width for all signals, and one of each signal alone where there are several."""
        shapes = self.parameters[3:]
        return [
            Hypothesis(
                self.key,
                f"{self.key} of {describe_signals(names)}",
                tuple(
                    dict.fromkeys(SIGNALS[:3], 0.0) | dict.fromkeys(names, width_s) | {"tails": tails, "late": late}
                    for width_s in STARTS_S
                    for tails, late in ((0.0, 0.0), (1.0, 0.0), (0.0, 0.5))
                ),
                (self.free(*names), *(self.free(item.name) for item in shapes)),
            )
            for names in scope.list_signal_sets(SIGNALS[:3])
        ]


TERM = Smoothing()
