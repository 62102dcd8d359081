"""Clock offset: the clock of one instrument, or of all, is late."""

from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import SignalDelays, Term, TermValues

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

    def signal_delays(self, values: TermValues) -> SignalDelays:
        """Return the offsets of the four clocks."""
        return SignalDelays(**values)

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return a common offset of all clocks and, for a recording of several signals, one offset per signal."""
        clocks = tuple(item.name for item in self.parameters)
        single = [(name,) for name in scope.signals] if len(scope.signals) > 1 else []
        return [
            Hypothesis(
                self.key,
                f"{self.key} of {'all signals' if len(names) > 1 else names[0]}",
                (dict.fromkeys(clocks, 0.0) | dict.fromkeys(names, START_S),),
                (self.free(*names),),
                is_linear=True,
            )
            for names in (clocks, *single)
        ]


TERM = ClockOffset()
