"""The paper's outcomes by simulation of a parameter set with its terms.

`paper_outcomes` has the same outcomes in closed form, for sets without terms.
"""

from dataclasses import dataclass
from math import pi
from typing import NamedTuple

import numpy as np

from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.validation.paper_outcomes import FULL_POWER_W, GAS_J_PER_K, LONG_PULSE_S
from optodrive.physics.paper_facts import AMBIENT_C, load_paper_facts
from optodrive.physics.parameters import ParameterSet
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.terms.gas_membrane import ATMOSPHERE_PA

AMBIENT_K = AMBIENT_C + ZERO_CELSIUS_K
SAMPLE_S = 1e-4
WIDTH_LADDER_S = np.geomspace(1.5e-3, 80e-3, 48)
"""Pulse widths between which the width that reaches a height is interpolated."""
STEADY_PERIODS = 24
"""Periods after which a train counts as steady."""


@dataclass(frozen=True)
class _Stimulus:
    """A train of equal pulses on one pixel."""

    width_mm: float
    on_s: float
    power_w: float = FULL_POWER_W
    off_s: float = 0.0
    repeats: int = 1

    def pulses(self) -> FloatArray:
        """Return the pulses, [n, 4] start_s, width_s, power_w, pixel 0."""
        period_s = self.on_s + self.off_s
        return np.array([[k * period_s, self.on_s, self.power_w, 0.0] for k in range(self.repeats)])


class _Responses(NamedTuple):
    """Responses to several stimuli: [m, stimuli]."""

    absorber_k: FloatArray
    displacement_m: FloatArray
    force_n: FloatArray


def simulate_outcomes(parameters: ParameterSet) -> dict[str, float]:
    """Return every outcome of `paper_outcomes.OUTCOMES` by fact, SI, temperatures in °C as in the paper."""
    return (
        _simulate_pulse_outcomes(parameters)
        | _simulate_train_outcomes(parameters)
        | {"z_repeat_w040": _simulate_repeatability_m(parameters)}
    )


def _simulate(parameters: ParameterSet, stimuli: list[_Stimulus], t_s: FloatArray) -> _Responses:
    """Simulate with the set's planner terms, or with all of its terms if it names none for planning."""
    keys = parameters.planner_terms or parameters.terms
    active = ActiveTerms.from_values({key: parameters.term_values(key) for key in keys})
    responses = [
        simulate_signals(
            PixelExperiment(stimulus.pulses(), 0, AMBIENT_K, (t_s, t_s, t_s), dose_before=1.0, session_time=1.0),
            parameters.build_pixel(stimulus.width_mm * 1e-3),
            active,
        )
        for stimulus in stimuli
    ]
    return _Responses(*(np.stack(signal, axis=1) for signal in zip(*responses, strict=True)))


def _simulate_pulse_outcomes(parameters: ParameterSet) -> dict[str, float]:
    single = [
        _Stimulus(0.20, LONG_PULSE_S),
        _Stimulus(0.75, LONG_PULSE_S),
        _Stimulus(0.40, 8e-3),
        _Stimulus(0.55, LONG_PULSE_S),
        _Stimulus(0.55, LONG_PULSE_S, 0.5 * FULL_POWER_W),
    ]
    ladder = [_Stimulus(0.55, width_s) for width_s in WIDTH_LADDER_S]
    t_s = np.arange(1.0, 0.1 / SAMPLE_S) * SAMPLE_S
    responses = _simulate(parameters, single + ladder, t_s)
    absorber_k, displacement_m, force_n = (
        values.max(axis=0) for values in (responses.absorber_k, responses.displacement_m, responses.force_n)
    )
    heights_m = displacement_m[len(single) :]
    absorbed_j = parameters.epsilon.value * FULL_POWER_W * LONG_PULSE_S
    work_j = 0.5 * force_n[0] * displacement_m[0]
    # The paper derives the gas temperature from the force by the gas law on the whole aperture; so does the model.
    gas_k = force_n[0] * AMBIENT_K / (ATMOSPHERE_PA * pi * load_paper_facts()["cavity_r"].value ** 2)
    outcomes = {
        "T_peak_w020": AMBIENT_C + absorber_k[0],
        "dT_peak_w020": absorber_k[0],
        "T_peak_w075": AMBIENT_C + absorber_k[1],
        "z_peak_w020": displacement_m[0],
        "z_peak_w075": displacement_m[1],
        "z_tp8_w040": displacement_m[2],
        "F_peak_w020": force_n[0],
        "F_peak_w055": force_n[3],
        "F_linear_in_P": force_n[3] / (2.0 * force_n[4]),
        "dT_air_isometric": gas_k,
        "dQ_air": GAS_J_PER_K * gas_k,
        "eta_stroke": work_j / absorbed_j,
        "eta_qt": GAS_J_PER_K * gas_k / absorbed_j,
        "eta_tm": work_j / (GAS_J_PER_K * gas_k),
        "N_50um": 1.0 / np.interp(50e-6, heights_m, WIDTH_LADDER_S, right=np.inf),
        "N_400um": 1.0 / np.interp(400e-6, heights_m, WIDTH_LADDER_S, right=np.inf),
    }
    return {name: float(value) for name, value in outcomes.items()}


def _simulate_train_outcomes(parameters: ParameterSet) -> dict[str, float]:
    tau_s = round(parameters.build_pixel(0.55e-3).tau_s, 6)
    quick = _Stimulus(0.55, 2.5e-3, off_s=2.5e-3, repeats=2 * STEADY_PERIODS)
    slow = _Stimulus(0.55, tau_s, off_s=tau_s, repeats=STEADY_PERIODS // 2)
    single = _Stimulus(0.55, tau_s)
    ends_s = {stimulus: stimulus.repeats * (stimulus.on_s + stimulus.off_s) for stimulus in (quick, slow)}
    final_times_s = {
        stimulus: end_s - np.linspace(1.0, 0.0, 401) * 2 * stimulus.on_s for stimulus, end_s in ends_s.items()
    }
    begin_s = np.arange(1.0, 600.0) * SAMPLE_S
    t_s = np.unique(np.concatenate([begin_s, *final_times_s.values()]))
    heights_m = _simulate(parameters, [quick, slow, single], t_s).displacement_m

    def steady_m(column: int, stimulus: _Stimulus) -> FloatArray:
        return np.asarray(np.interp(final_times_s[stimulus], t_s, heights_m[:, column]))

    first_m = float(heights_m[t_s <= begin_s[-1], 2].max())
    ripple_m = steady_m(1, slow)
    return {
        "dpp_200Hz": float(np.ptp(steady_m(0, quick))),
        "dpp_law": float(np.ptp(ripple_m)) / first_m,
        "slow_law": float(np.trapezoid(ripple_m, dx=1.0 / 400)) / first_m,
    }


def _simulate_repeatability_m(parameters: ParameterSet) -> float:
    """Return the spread of the peaks of four equal pulses 5 s apart, m."""
    train = _Stimulus(0.40, LONG_PULSE_S, off_s=4.95, repeats=4)
    around_s = [k * 5.0 + LONG_PULSE_S + np.arange(1, 41) * 2.5e-4 for k in range(4)]
    heights_m = _simulate(parameters, [train], np.concatenate(around_s)).displacement_m
    return float(np.ptp(heights_m.reshape(4, -1).max(axis=1)))
