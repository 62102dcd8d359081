"""Time rate: the clock that times the samples of one instrument, or of all, is fast or slow."""

from optodrive.physics.term import BySignal, Term, TermValues, build_signal_parameters


class TimeRate(Term):
    """Stated time = (1 + rate) · true time since the start of the run, for each instrument."""

    key = "time_rate"
    label = "an instrument's time axis has a wrong rate"
    parameters = build_signal_parameters("1", 2e-3, -0.05, 0.05, "nominal sampling rates, within 2 %")
    starts_by_signal = (2e-3, 1e-2, -1e-2)  # edges late in a train move by more than their width at the large ones
    cannot_add_heat = True
    is_exact = True
    subsystems = ("pixels", "mirrors")
    signature = "edges, the later in a run the further off"
    remedy = "time the samples by a second clock; late edges of a pixel or a laser do not move with it."

    def signal_rates(self, values: TermValues) -> BySignal:
        """Return the rates of the four clocks."""
        return BySignal(**values)


TERM = TimeRate()
