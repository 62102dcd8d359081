"""Heating of the whole panel, the surroundings of all walls, by the light on every pixel."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import (
    PANEL_HELD,
    POWER_W,
    Kernels,
    Term,
    add_follower,
)


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Heat the panel by a share of the light and cool it to the room, unless it is held."""
    x[s] = 0.0 if c[PANEL_HELD] > 0.0 else (v[2] * c[POWER_W] - y[s] / v[0]) / v[1]


class PanelHeating(Term):
    """C dp/dt = share · P − p / R, with P the light on any pixel. Bridge and gas see the panel's rise p."""

    key = "panel_heating"
    label = "the whole panel heats up"
    parameters = (
        TermParameter("resistance", "K/W", 5.0, 0.05, 200.0, "a panel of 10 × 10 to 300 × 300 mm² in still air"),
        TermParameter(
            "capacity",
            "J/K",
            40.0,
            1.0,
            5000.0,
            "such a panel of acrylic and polystyrene",
            starts=(4.0, 20.0, 100.0, 500.0),
        ),
        TermParameter("share", "1", 0.65, 0.3, 1.0, "the light that becomes heat: the absorptance", is_shape=True),
    )
    followers = ("panel_k",)
    has_panel_state = True
    kernels = Kernels(rates=rates, wall_rise=add_follower)
    signature = "a rise of all pixels, also those without light, over minutes of light on any"

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one hypothesis, whose share is the default, if light on one pixel can show on another."""
        if len(scope.illuminated | frozenset(scope.pixels)) < 2:
            return []
        (whole,) = super().build_hypotheses(scope)
        return [Hypothesis(self.key, self.key, whole.starts, (self.free("resistance"), self.free("capacity")))]


TERM = PanelHeating()
