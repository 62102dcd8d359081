"""Mirror lag: the mirrors follow their commands with a delay, a resonance and a slew limit."""

from optodrive.device.servo import Servo
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import Term, TermValues


class MirrorLag(Term):
    """The servo of `optodrive.device.servo`: delay, slew limit and a second-order response."""

    key = "mirror_lag"
    label = "the mirrors lag behind their commands"
    parameters = (
        TermParameter(
            "frequency",
            "Hz",
            1000.0,
            100.0,
            2e4,
            "undamped servo, 0.3 to 3 kHz",
            starts=(1000.0, 300.0, 450.0, 700.0, 1500.0, 2200.0, 3300.0, 5000.0),
        ),
        TermParameter("damping", "1", 0.6, 0.1, 2.0, "0.3 to 1", starts=(0.6, 0.35, 0.9), is_shape=True),
        TermParameter("delay", "s", 2e-5, 0.0, 2e-3, "driver and filter", (0.0, 5e-5, 1.5e-4, 4e-4), is_shape=True),
        TermParameter(
            "slew",
            "rad/s",
            500.0,
            5.0,
            5000.0,
            "full current, small-angle galvos",
            starts=(5000.0, 60.0, 150.0, 400.0),
            is_shape=True,
        ),
    )
    cannot_add_heat = True
    subsystems = ("mirrors",)
    fit_every_start = True
    signature = "mirror positions after steps of three sizes"
    detection_limit = "mirror lag of more than half a sample"

    def servo(self, values: TermValues) -> Servo:
        """Return the servo of both mirrors."""
        return Servo(**values)


TERM = MirrorLag()
