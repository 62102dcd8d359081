"""High-pass: an instrument's input is AC coupled."""

from math import pi

from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, describe_signals
from optodrive.physics.signal_filters import low_pass
from optodrive.physics.term import BySignal, Term, TermValues, build_signal_parameters

SIGNALS = BySignal._fields[:3]
STARTS_HZ = (0.03, 0.3, 3.0)


class HighPass(Term):
    """dy/dt = dx/dt − 2π · cut-off frequency · y, with x the signal and y its record."""

    key = "high_pass"
    label = "an instrument's input is AC coupled"
    parameters = build_signal_parameters(
        "Hz", 0.3, 0.0, 30.0, "AC inputs of oscilloscopes and amplifiers, 0.1 to 10 Hz", SIGNALS
    )
    cannot_add_heat = True
    signature = "a signal that falls while the drive is held, and undershoots after it"
    removes_zero = True
    twin = "gas_leak"
    remedy = "couple the input DC, state coupling = DC in the runs and record again: what remains is the pixel."

    def record(self, values: TermValues, signal: str, t_s: FloatArray, value: FloatArray) -> FloatArray:
        """Return the signal behind the high-pass, [n]."""
        cutoff_hz = values.get(signal, 0.0)
        return value if cutoff_hz <= 0.0 else value - low_pass(t_s, value, 1.0 / (2.0 * pi * cutoff_hz))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one cut-off frequency of each signal, and one of all signals where there are several."""
        return [
            Hypothesis(
                self.key,
                f"{self.key} of {describe_signals(names)}",
                tuple(dict.fromkeys(SIGNALS, 0.0) | dict.fromkeys(names, start) for start in STARTS_HZ),
                (self.free(*names),),
            )
            for names in scope.list_signal_sets(SIGNALS)
        ]


TERM = HighPass()
