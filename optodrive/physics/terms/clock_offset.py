"""Clock offset: the clock of one instrument, or of all, is late."""

from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import BySignal, Term, TermValues

START_S = 2e-4


class ClockOffset(Term):
    """A constant delay of each instrument's time axis."""

    key = "clock_offset"
    label = "an instrument's clock is offset"
    parameters = (
        TermParameter("temperature", "s", 1e-4, -5e-3, 5e-3, "0.05 to 3 ms in either direction", neutral=0.0),
        TermParameter("displacement", "s", 1e-4, -5e-3, 5e-3, "as above", neutral=0.0),
        TermParameter("force", "s", 1e-4, -5e-3, 5e-3, "as above", neutral=0.0),
        TermParameter("mirrors", "s", 1e-4, -5e-3, 5e-3, "as above", neutral=0.0),
    )
    cannot_add_heat = True
    is_exact = True
    subsystems = ("pixels", "mirrors")
    signature = "every edge, in proportion to the slope"
    remedy = "trigger the instrument by the light itself, and record again."

    def signal_delays(self, values: TermValues) -> BySignal:
        """Return the offsets of the four clocks."""
        return BySignal(**values)

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return a common offset of all clocks and, for a recording of several signals, one offset per signal."""
        return self.build_hypotheses_by_signal(scope, START_S)


TERM = ClockOffset()
