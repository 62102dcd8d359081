"""The paper's outcomes by a parameter set: in closed form without terms, by simulation with its terms.

`OUTCOMES` is the closed form, `simulate_outcomes` the simulation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.validation.stimuli import (
    AMBIENT_K,
    FULL_POWER_W,
    LONG_PULSE_S,
    SteadyTrain,
    compute_steady_train,
    pulse_peak_k,
    width_to_reach_s,
)
from optodrive.physics.paper_facts import AMBIENT_C, load_paper_facts
from optodrive.physics.parameters import ParameterSet
from optodrive.physics.pixel import advance, cooling_peak
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.terms.mechanical import ATMOSPHERE_PA

OutcomeFunction = Callable[[ParameterSet], float]

GAS_J_PER_K = load_paper_facts()["C_gas"].value

FITTED_ON = {"kappa": "z_peak_w020", "tau_g": "dpp_200Hz", "phi": "F_peak_w020"}
"""Parameters of the calibrated set and the one fact each was fitted to; every other outcome is a prediction."""

DERIVED_FROM_FITTED = {"eta_stroke"}
"""Outcomes computed from fitted facts only, hence no test of the set."""

EXTENDED_FITTED_ON = {
    "bridge_conductivity.exponent": "dT_peak_w020",
    "gas_membrane.share": "z_peak_w020",
    "tau_g": "dpp_200Hz",
    "force_area.area": "F_peak_w020",
}
"""Parameters of the extended set and their facts: those of the calibrated set and the temperature of the same pixel."""

EXTENDED_DERIVED_FROM_FITTED = {"T_peak_w020", "dT_air_isometric", "dQ_air", "eta_stroke", "eta_qt", "eta_tm"}
"""Outcomes that follow from these by arithmetic; the gas rise is derived from the force as in the paper."""


def _rise_k(width_mm: float) -> OutcomeFunction:
    return lambda s: advance(s.build_pixel(width_mm * 1e-3), 0.0, 0.0, FULL_POWER_W, LONG_PULSE_S)[0]


def _temperature_c(width_mm: float) -> OutcomeFunction:
    rise_k = _rise_k(width_mm)
    return lambda s: AMBIENT_C + rise_k(s)


def _gas_k(s: ParameterSet, width_mm: float, power_w: float = FULL_POWER_W, pulse_s: float = LONG_PULSE_S) -> float:
    return pulse_peak_k(s.build_pixel(width_mm * 1e-3), power_w, pulse_s)


def _displacement_m(width_mm: float, pulse_s: float = LONG_PULSE_S) -> OutcomeFunction:
    return lambda s: s.kappa.value * _gas_k(s, width_mm, pulse_s=pulse_s)


def _force_n(width_mm: float) -> OutcomeFunction:
    return lambda s: s.phi.value * _gas_k(s, width_mm)


def _absorbed_j(s: ParameterSet) -> float:
    return s.epsilon.value * FULL_POWER_W * LONG_PULSE_S


def _stroke_work_j(s: ParameterSet) -> float:
    return 0.5 * _force_n(0.20)(s) * _displacement_m(0.20)(s)


def _gas_heat_j(s: ParameterSet) -> float:
    return GAS_J_PER_K * _gas_k(s, 0.20)


def _pixels_per_s(height_m: float) -> OutcomeFunction:
    return lambda s: 1.0 / width_to_reach_s(s.build_pixel(0.55e-3), FULL_POWER_W, height_m)


def _dpp_200hz_m(s: ParameterSet) -> float:
    train = compute_steady_train(s.build_pixel(0.55e-3), FULL_POWER_W, 2.5e-3, 2.5e-3)
    return s.kappa.value * (train.max_k - train.min_k)


def _train_at_tau(s: ParameterSet) -> tuple[SteadyTrain, float]:
    pixel = s.build_pixel(0.55e-3)
    return compute_steady_train(pixel, FULL_POWER_W, pixel.tau_s, pixel.tau_s), pulse_peak_k(
        pixel, FULL_POWER_W, pixel.tau_s
    )


def _dpp_over_first(s: ParameterSet) -> float:
    train, first_k = _train_at_tau(s)
    return (train.max_k - train.min_k) / first_k


def _mean_over_first(s: ParameterSet) -> float:
    train, first_k = _train_at_tau(s)
    return train.mean_k / first_k


def _force_per_power(s: ParameterSet) -> float:
    return _gas_k(s, 0.55) / (2.0 * _gas_k(s, 0.55, power_w=0.5 * FULL_POWER_W))


def _repeatability_m(s: ParameterSet) -> float:
    pixel = s.build_pixel(0.40e-3)
    theta_k = gamma_k = 0.0
    peaks_k = []
    for _ in range(4):
        theta_k, gamma_k = advance(pixel, theta_k, gamma_k, FULL_POWER_W, LONG_PULSE_S)
        peaks_k.append(cooling_peak(pixel, theta_k, gamma_k)[0])
        theta_k, gamma_k = advance(pixel, theta_k, gamma_k, 0.0, 4.95)
    return pixel.kappa_m_per_k * (max(peaks_k) - min(peaks_k))


def _r_width_product_k_m_per_w(s: ParameterSet) -> float:
    rows = [(row.R.value, 1.0 / row.width_m) for row in s.bridge]
    return sum(r * inverse for r, inverse in rows) / sum(inverse**2 for _, inverse in rows)


def _resistance(width_mm: float) -> OutcomeFunction:
    return lambda s: s.build_pixel(width_mm * 1e-3).r_k_per_w


def _capacity(width_mm: float) -> OutcomeFunction:
    return lambda s: s.build_pixel(width_mm * 1e-3).c_j_per_k


WIDTHS_MM = (0.20, 0.25, 0.40, 0.55, 0.75)
"""Bridge widths of Table S3."""

INPUTS: dict[str, OutcomeFunction] = {
    "absorbed_power": lambda s: s.epsilon.value * FULL_POWER_W,
    "epsilon": lambda s: s.epsilon.value,
    **{f"R_w{100.0 * width_mm:03.0f}": _resistance(width_mm) for width_mm in WIDTHS_MM},
    **{f"C_w{100.0 * width_mm:03.0f}": _capacity(width_mm) for width_mm in WIDTHS_MM},
    "C_mean": lambda s: sum(row.C.value for row in s.bridge) / len(s.bridge),
    "R_of_w": _r_width_product_k_m_per_w,
    "energy_range_high": lambda s: FULL_POWER_W * LONG_PULSE_S,
}
"""Facts that a set takes from the paper or that follow from it by arithmetic."""

OUTCOMES: dict[str, OutcomeFunction] = {
    "T_peak_w020": _temperature_c(0.20),
    "dT_peak_w020": _rise_k(0.20),
    "T_peak_w075": _temperature_c(0.75),
    "z_peak_w020": _displacement_m(0.20),
    "z_peak_w075": _displacement_m(0.75),
    "z_tp8_w040": _displacement_m(0.40, 8e-3),
    "z_repeat_w040": _repeatability_m,
    "F_peak_w020": _force_n(0.20),
    "F_peak_w055": _force_n(0.55),
    "F_linear_in_P": _force_per_power,
    "dT_air_isometric": lambda s: _gas_k(s, 0.20),
    "dQ_air": _gas_heat_j,
    "eta_stroke": lambda s: _stroke_work_j(s) / _absorbed_j(s),
    "eta_qt": lambda s: _gas_heat_j(s) / _absorbed_j(s),
    "eta_tm": lambda s: _stroke_work_j(s) / _gas_heat_j(s),
    "N_50um": _pixels_per_s(50e-6),
    "N_400um": _pixels_per_s(400e-6),
    "dpp_200Hz": _dpp_200hz_m,
    "dpp_law": _dpp_over_first,
    "slow_law": _mean_over_first,
}
"""Facts that follow from a set: fitted (FITTED_ON) or predicted."""

NOT_MODELLED = {
    "incident_power": "the drive of all other rows",
    "acrylic_transmission": "a part of ε: 0.924 × 0.723 = 0.668",
    "pgs_absorption": "a part of ε: 0.924 × 0.723 = 0.668",
    "pwm_frequency": "a setting of the laser",
    "T_fea_w020": "an outcome of the paper's finite element model",
    "T_fea_w075": "an outcome of the paper's finite element model",
    "z_fea_w020": "an outcome of the paper's finite element model",
    "z_fea_w075": "an outcome of the paper's finite element model",
    "V_pixel": "displacement is linear in the gas rise here, without a volume",
    "energy_range_low": "the paper states no pulse width or height for it",
    "C_gas": "converts a gas rise to heat (dQ_air, eta_qt, eta_tm), and determines tau_g of the literal set",
    "membrane_E": "determines kappa of the literal set; the calibrated set takes kappa from a displacement",
    "membrane_nu": "determines kappa of the literal set; the calibrated set takes kappa from a displacement",
    "membrane_h": "determines kappa of the literal set; the calibrated set takes kappa from a displacement",
    "cavity_r": "determines kappa and phi of the literal set",
    "pitch_display": "a property of the lattice, not of one pixel",
    "pitch_perception": "a property of the lattice, not of one pixel",
    "pgs_k": "R is taken from Table S3; R from k requires the bridge length, which the paper does not state",
}
"""Facts that no parameter set here can predict, and why."""

REMARKS = {
    "F_peak_w055": "from w = 0.20 to 0.55 mm the force falls to 0.56, the gas rise to 0.47: no single φ fits both",
    "dT_air_isometric": "20.5 K follows from the force on the whole aperture at constant volume; a membrane at "
    "0.97 mm adds 44 % to the volume, which requires a gas rise of more than 100 K",
    "dQ_air": "follows dT_air_isometric; 0.18 mJ for 20.5 K is 8.8 µJ/K, where C_gas is 10",
    "eta_qt": "follows dT_air_isometric",
    "eta_tm": "follows dT_air_isometric: the same work from more heat",
    "N_50um": "217/s leaves 4.6 ms per pulse, in which the model rises twice as high; at every width of Table S3 it "
    "reaches 374/s or more; the measured 155 µm at 8 ms also implies some 90 µm there",
    "N_400um": "26.5/s leaves 37.7 ms per pulse, 7 % too high here; near the plateau 7 % of height is 24 % of time",
}
"""Explanations of the deviations of the calibrated set of more than 15 %."""


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
    """Return every outcome of `OUTCOMES` by fact, SI, temperatures in °C as in the paper."""
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
