"""A mirror follows its command late: a delay, a resonance, a slew limit."""

from optodrive.physics.term import Term, TermParameter


class MirrorLag(Term):
    """A mirror follows its command late: a delay, a resonance, a slew limit."""

    key = "mirror_lag"
    parameters = (
        TermParameter("frequency", "Hz", 1000.0, 100.0, 2e4, "undamped servo, 0.3 to 3 kHz"),
        TermParameter("damping", "1", 0.6, 0.1, 2.0, "0.3 to 1"),
        TermParameter("delay", "s", 2e-5, 0.0, 2e-3, "driver and filter"),
        TermParameter("slew", "rad/s", 500.0, 5.0, 5000.0, "full current, small-angle galvos"),
    )
    cannot_add_heat = True
    signature = "mirror positions after steps of three sizes"


TERM = MirrorLag()
