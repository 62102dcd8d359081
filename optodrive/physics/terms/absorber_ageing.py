"""Absorber ageing: the absorbed fraction falls with the light received, with time, or in a step."""

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import DOSE, SESSION_TIME, HeatGainBound, Kernels, OperatingEnvelope, Term, TermValues

LABELS = {
    "share": "absorber_ageing",
    "time_share": "absorber_ageing in time",
    "step_share": "absorber_ageing in a step",
}
STEPS_AT = tuple(np.linspace(-0.9, 0.9, 13).round(2).tolist())


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by the absorption left after dose, time and a step."""
    u = c[SESSION_TIME]
    lost = v[0] * c[DOSE] + v[1] * 0.5 * (1.0 + u)
    if u > v[3]:
        lost += v[2]
    return float(x * (1.0 - lost))


class AbsorberAgeing(Term):
    """P (1 − share · dose − time_share · (1 + u)/2 − [u > step_at] · step_share), u the session time from −1 to 1.

    The dose is relative to the recording's largest.
    """

    key = "absorber_ageing"
    label = "the absorber ages and absorbs less"
    parameters = (
        TermParameter("share", "1", 0.05, -0.3, 0.3, "lost over the recording's whole dose, 1 to 20 %", neutral=0.0),
        TermParameter("time_share", "1", 0.0, -0.3, 0.3, "lost over the recording's whole duration", neutral=0.0),
        TermParameter("step_share", "1", 0.0, -0.3, 0.3, "lost at once, as by a burn or a stain", neutral=0.0),
        TermParameter("step_at", "1", 0.0, -1.0, 1.0, "session time of the step", is_shape=True),
    )
    kernels = Kernels(optical_power=optical_power)
    varies_between_runs = True
    signature = "the same pulse early and late in the session"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound | None:
        """Return no gain for an absorber that loses absorption, and no bound for one that gains it."""
        return HeatGainBound() if min(values[name] for name in LABELS) >= 0.0 else None

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one linear hypothesis per way of ageing, a step at several times."""
        none = {"share": 0.0, "time_share": 0.0, "step_share": 0.0, "step_at": 0.0}
        return [
            Hypothesis(
                self.key,
                label,
                tuple(none | {name: 0.05, "step_at": at} for at in (STEPS_AT if name == "step_share" else (0.0,))),
                (self.free(name),),
                is_linear=True,
            )
            for name, label in LABELS.items()
        ]


TERM = AbsorberAgeing()
