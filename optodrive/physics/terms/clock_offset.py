"""Clock offset: the clock of one instrument, or of all, is late."""

from optodrive.physics.term import BySignal, Term, TermValues, build_signal_parameters


class ClockOffset(Term):
    """A constant delay of each instrument's time axis."""

    key = "clock_offset"
    label = "an instrument's clock is offset"
    parameters = build_signal_parameters("s", 1e-4, -5e-3, 5e-3, "0.05 to 3 ms in either direction")
    starts_by_signal = (2e-4,)
    cannot_add_heat = True
    is_exact = True
    subsystems = ("pixels", "mirrors")
    signature = "every edge, in proportion to the slope"
    remedy = "trigger the instrument by the light itself, and record again."

    def signal_delays(self, values: TermValues) -> BySignal:
        """Return the offsets of the four clocks."""
        return BySignal(**values)


TERM = ClockOffset()
