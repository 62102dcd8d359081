"""Terms of light, between the command and the heat of an absorber.

- Laser turn-on: the diode reaches its power with a delay after the gate opens.
- Laser lag: the emitted power follows its command with a time constant, at both edges of a pulse.
- Laser droop: the diode's power falls as it warms within a pulse, and recovers between pulses.
- Power nonlinearity: the laser's power is not proportional to its command, by a threshold or a curve.
- Beam misalignment: on one pixel, part of the beam misses the absorber and heats its wall instead.
- Absorber ageing: the absorbed fraction falls with the light received, with time, or in a step.
- Mirror lag: the mirrors follow their commands with a delay, a resonance and a slew limit.
"""

from math import exp

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.device.servo import Servo
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import (
    DOSE,
    FULL_W,
    ILLUMINATED_PIXEL,
    IS_TARGET,
    POWER_W,
    SESSION_TIME,
    SINCE_EDGE_S,
    HeatGainBound,
    Kernels,
    OperatingEnvelope,
    Term,
    TermValues,
    add_follower,
)


@kernel
def laser_turn_on_optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by 1 − e^(−t / time), with t the time since the gate opened."""
    return float(x * (1.0 - exp(-c[SINCE_EDGE_S] / v[0])))


class LaserTurnOn(Term):
    """P (1 − e^(−t / time)), with t the time since the gate opened."""

    key = "laser_turn_on"
    label = "the laser takes time to reach its power"
    parameters = (
        TermParameter(
            "time",
            "s",
            5e-4,
            1e-6,
            4e-3,
            "thermal and driver transients of blue diodes, 0.02 to 3 ms",
            starts=(1e-4, 4e-4, 1.5e-3),
        ),
    )
    kernels = Kernels(optical_power=laser_turn_on_optical_power)
    is_fast = True
    cannot_add_heat = True
    signature = "the first 2 ms of short pulses"


LAG_SETTLING_SHARE = 0.1
"""Share of the time since an edge below which the time constant does not count: its effect has ended by then, and the
integrator's steps, a fifth of that time, stay stable."""
MIN_ABSORBER_TIME_S = 8e-3
"""Lower bound on the time constant of an absorber, s; Table S3 has 10 ms and more."""


@kernel
def laser_lag_rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let the emitted power follow the commanded one."""
    x[s] = (c[POWER_W] - y[s]) / max(v[0], LAG_SETTLING_SHARE * c[SINCE_EDGE_S])


@kernel
def laser_lag_optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by the emitted share of the command."""
    return float(x * y[s] / c[POWER_W])


@kernel
def laser_lag_decaying_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add the power that is still emitted, W."""
    return float(x + y[s])


class LaserLag(Term):
    """time · dP/dt = P_command − P, when the gate opens and when it closes."""

    key = "laser_lag"
    label = "the laser follows its command with a time constant, at both edges"
    parameters = (
        TermParameter(
            "time", "s", 5e-4, 5e-6, 4e-3, "drivers with a filter, 0.02 to 3 ms", starts=(5e-5, 2e-4, 6e-4, 2e-3)
        ),
    )
    followers = ("emitted_w",)
    has_laser_state = True
    kernels = Kernels(
        rates=laser_lag_rates, optical_power=laser_lag_optical_power, decaying_power=laser_lag_decaying_power
    )
    is_fast = True
    signature = "the first milliseconds after either edge of a pulse"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the gain of a decaying absorber, which the same energy reaches later: 1 / (1 − time / absorber's)."""
        return HeatGainBound(power_factor=1.0 / (1.0 - values["time"] / MIN_ABSORBER_TIME_S))


@kernel
def laser_droop_rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let the warmth of chip and mount follow the relative power with their own time constants."""
    x[s] = (c[POWER_W] / c[FULL_W] - y[s]) / v[1]
    x[s + 1] = (c[POWER_W] / c[FULL_W] - y[s + 1]) / (v[1] * v[2])


@kernel
def laser_droop_optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by 1 − share · mean warmth of chip and mount."""
    return float(x * (1.0 - 0.5 * v[0] * (y[s] + y[s + 1])))


class LaserDroop(Term):
    """P (1 − share · (h₁ + h₂)/2), with h₁, h₂ the warmth of chip and mount, which follow P / P_full."""

    key = "laser_droop"
    label = "the laser's power falls while it is on"
    parameters = (
        TermParameter("share", "1", 0.08, 0.0, 0.4, "power lost in the long run, 1 to 20 %"),
        TermParameter(
            "time", "s", 0.05, 2.5e-3, 2.0, "warming of chip and mount, 3 ms to 1 s", starts=(5e-3, 0.03, 0.2, 1.0)
        ),
        TermParameter("spread", "1", 1.5, 1.0, 30.0, "the mount's time over the chip's", is_shape=True),
    )
    followers = ("chip_1", "mount_1")
    has_laser_state = True
    kernels = Kernels(rates=laser_droop_rates, optical_power=laser_droop_optical_power)
    cannot_add_heat = True
    signature = "long pulses and trains, but not in cooling"


NONLINEARITY_START = 0.1


@kernel
def power_nonlinearity_optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Apply the threshold, then the curve, to the relative power. Full power stays full power."""
    if x <= 0.0:
        return x
    share, threshold = c[POWER_W] / c[FULL_W], v[0] / c[FULL_W]
    if threshold >= 1.0:
        return 0.0
    left = max(0.0, (share - threshold) / (1.0 - threshold))
    return float(x / share * left * (1.0 + v[1] * (1.0 - left)))


class PowerNonlinearity(Term):
    """q (1 + curvature · (1 − q)) with q = (p − threshold) / (1 − threshold), all relative to full power."""

    key = "power_nonlinearity"
    label = "the laser's power is not proportional to its command"
    parameters = (
        TermParameter(
            "threshold", "W", 0.05, 0.0, 0.5, "duty at which the diode begins to lase, in watts of command", neutral=0.0
        ),
        TermParameter("curvature", "1", 0.05, -0.3, 0.3, "bend of power against command, full power kept", neutral=0.0),
    )
    kernels = Kernels(optical_power=power_nonlinearity_optical_power)
    signature = "a series of powers with unchanged pulse shapes"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the curve's largest gain, which it reaches at low power. A threshold only reduces power.

        Raises InputError for a threshold that full power does not reach.
        """
        if values["threshold"] >= envelope.full_w:
            expected = f"less than the laser's full power, {envelope.full_w:g} W"
            raise InputError(f"terms.{self.key}.threshold", values["threshold"], expected)
        return HeatGainBound(power_factor=1.0 + max(0.0, values["curvature"]))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one hypothesis per parameter if the recording has several powers. The curve alone is linear."""
        zero = {item.name: 0.0 for item in self.parameters}
        return [
            Hypothesis(
                self.key,
                f"{self.key}: {name}",
                (zero | {name: NONLINEARITY_START},),
                (self.free(name),),
                is_linear=name == "curvature",
            )
            for name in zero
            if scope.power_levels > 1
        ]


@kernel
def beam_misalignment_optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by 1 − share on the misaligned pixel."""
    return float(x * (1.0 - v[0]) if c[ILLUMINATED_PIXEL] == v[1] else x)


@kernel
def beam_misalignment_rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Heat the wall towards resistance · missing power while the misaligned pixel is illuminated."""
    missing_w = v[0] * c[POWER_W] if c[ILLUMINATED_PIXEL] == v[1] and c[IS_TARGET] > 0.0 else 0.0
    x[s] = (v[2] * missing_w - y[s]) / v[3]


class BeamMisalignment(Term):
    """P (1 − share) on one pixel. The rest heats its wall: time · dm/dt = resistance · share · P − m."""

    key = "beam_misalignment"
    label = "on one pixel part of the beam misses the absorber"
    parameters = (
        TermParameter("share", "1", 0.1, 0.0, 0.5, "missing the absorber, 2 to 30 %"),
        TermParameter("pixel", "1", 0.0, 0.0, 1e6, "the pixel's index"),
        TermParameter("resistance", "K/W", 4.0, 0.01, 60.0, "the wall to its surroundings, 1 to 40 K/W"),
        TermParameter("time", "s", 0.5, 0.02, 20.0, "the wall's, 0.1 to 10 s"),
    )
    followers = ("missed_k",)
    kernels = Kernels(
        optical_power=beam_misalignment_optical_power, rates=beam_misalignment_rates, wall_rise=add_follower
    )
    signature = "a comparison of several pixels"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the wall's steady rise under continuous full power as a rise of everything."""
        return HeatGainBound(uniform_rise_k=values["resistance"] * values["share"] * envelope.all_power_w)

    def affected_pixel(self, values: TermValues) -> int | None:
        """Return the index of the misaligned pixel."""
        return int(values["pixel"])

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one hypothesis per measured and illuminated pixel, if there is a second one to compare it with."""
        free = tuple(self.free(name) for name in ("share", "resistance", "time"))
        start = {item.name: item.default for item in self.parameters}
        return [
            Hypothesis(self.key, f"{self.key} of pixel {pixel}", (start | {"pixel": float(pixel)},), free)
            for pixel in scope.pixels
            if pixel in scope.illuminated and len(scope.pixels) > 1
        ]


AGEING_LABELS = {
    "share": "absorber_ageing",
    "time_share": "absorber_ageing in time",
    "step_share": "absorber_ageing in a step",
}
AGEING_STEPS_AT = tuple(np.linspace(-0.9, 0.9, 13).round(2).tolist())


@kernel
def absorber_ageing_optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
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
    kernels = Kernels(optical_power=absorber_ageing_optical_power)
    varies_between_runs = True
    signature = "the same pulse early and late in the session"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound | None:
        """Return no gain for an absorber that loses absorption, and no bound for one that gains it."""
        return HeatGainBound() if min(values[name] for name in AGEING_LABELS) >= 0.0 else None

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one linear hypothesis per way of ageing, a step at several times."""
        none = {"share": 0.0, "time_share": 0.0, "step_share": 0.0, "step_at": 0.0}
        return [
            Hypothesis(
                self.key,
                label,
                tuple(
                    none | {name: 0.05, "step_at": at} for at in (AGEING_STEPS_AT if name == "step_share" else (0.0,))
                ),
                (self.free(name),),
                is_linear=True,
            )
            for name, label in AGEING_LABELS.items()
        ]


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
