"""Time rate: the clock that times the samples of one instrument, or of all, is fast or slow."""

from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import BySignal, Term, TermValues

START, LARGE = 2e-3, 1e-2
"""Rates from which a search begins; edges at the end of a train move by more than their width at the large ones."""


class TimeRate(Term):
    """Stated time = (1 + rate) · true time since the start of the run, for each instrument."""

    key = "time_rate"
    label = "an instrument's time axis has a wrong rate"
    parameters = (
        TermParameter("temperature", "1", START, -0.05, 0.05, "nominal sampling rates, within 2 %", neutral=0.0),
        TermParameter("displacement", "1", START, -0.05, 0.05, "as above", neutral=0.0),
        TermParameter("force", "1", START, -0.05, 0.05, "as above", neutral=0.0),
        TermParameter("mirrors", "1", START, -0.05, 0.05, "as above", neutral=0.0),
    )
    cannot_add_heat = True
    is_exact = True
    subsystems = ("pixels", "mirrors")
    signature = "edges, the later in a run the further off"
    remedy = "time the samples by a second clock; late edges of a pixel or a laser do not move with it."

    def signal_rates(self, values: TermValues) -> BySignal:
        """Return the rates of the four clocks."""
        return BySignal(**values)

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return a common rate of all clocks and, for a recording of several signals, one rate per signal."""
        return self.build_hypotheses_by_signal(scope, START, LARGE, -LARGE)


TERM = TimeRate()
