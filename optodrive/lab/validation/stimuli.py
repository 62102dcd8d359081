"""Gas response to the paper's stimuli: in closed form, or simulated if terms are active."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.paper_facts import AMBIENT_C, load_paper_facts
from optodrive.physics.pixel import GAS_FRACTION, Pixel, advance, cooling_peak, gas_peak
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

FULL_POWER_W = load_paper_facts()["incident_power"].value
LONG_PULSE_S = 50e-3
"""The paper's pulse width for peak temperatures, displacements and forces."""
AMBIENT_K = AMBIENT_C + ZERO_CELSIUS_K
MAX_PULSE_S = 1.0
"""Longest pulse considered; every relaxation time here is far shorter."""


def pulse_peak_k(pixel: Pixel, power_w: float, width_s: float) -> float:
    """Return the largest gas rise, K, after one pulse from the cold state."""
    return cooling_peak(pixel, *advance(pixel, 0.0, 0.0, power_w, width_s))[0]


def width_to_reach_s(pixel: Pixel, power_w: float, height_m: float) -> float:
    """Return the width, s, of the shortest pulse from the cold state to a height, infinite if it is unreachable."""
    target_k = height_m / pixel.kappa_m_per_k
    low_s, high_s = 0.0, MAX_PULSE_S
    if pulse_peak_k(pixel, power_w, high_s) < target_k:
        return float("inf")
    for _ in range(60):
        middle_s = 0.5 * (low_s + high_s)
        if pulse_peak_k(pixel, power_w, middle_s) < target_k:
            low_s = middle_s
        else:
            high_s = middle_s
    return high_s


Rises = tuple[float, float]
"""Of absorber and gas, K."""


@dataclass(frozen=True)
class SteadyTrain:
    """Gas rise, K, of a pulse train in its periodic steady state: minimum, maximum and mean over a period."""

    min_k: float
    max_k: float
    mean_k: float


def compute_steady_train(pixel: Pixel, power_w: float, width_s: float, gap_s: float) -> SteadyTrain:
    """Return the periodic steady state of pulses of width_s with gap_s between.

    The mean is exact: over a period no net heat is stored, so the mean rises equal the steady rises at the mean power.
    """
    (theta_k, gamma_k), gate_off_state = _find_steady_state(pixel, power_w, width_s, gap_s)
    max_k = max(gas_peak(pixel, theta_k, gamma_k, power_w, width_s)[0], cooling_peak(pixel, *gate_off_state, gap_s)[0])
    # With the gate off the gas has no minimum in the interior. The equations are linear, so the minimum during the
    # pulse is the maximum of the negated motion.
    min_k = -gas_peak(pixel, -theta_k, -gamma_k, -power_w, width_s)[0]
    mean_k = GAS_FRACTION * pixel.epsilon * pixel.r_k_per_w * power_w * width_s / (width_s + gap_s)
    return SteadyTrain(min_k, max_k, mean_k)


def _find_steady_state(pixel: Pixel, power_w: float, on_s: float, off_s: float) -> tuple[Rises, Rises]:
    """Return the rises of absorber and gas at gate on and at gate off of a steady train."""

    def advance_period(theta_k: float, gamma_k: float) -> FloatArray:
        return np.array(advance(pixel, *advance(pixel, theta_k, gamma_k, power_w, on_s), 0.0, off_s))

    # A period maps states linearly; the steady state is the fixed point of that map.
    offset = advance_period(0.0, 0.0)
    matrix = np.stack([advance_period(1.0, 0.0) - offset, advance_period(0.0, 1.0) - offset], axis=1)
    theta_k, gamma_k = np.linalg.solve(np.eye(2) - matrix, offset).tolist()
    return (theta_k, gamma_k), advance(pixel, theta_k, gamma_k, power_w, on_s)


PERIOD_SAMPLES = 48
"""Samples per period of a steady train."""
PEAK_TIMES_TAU = np.concatenate([[0.0], np.geomspace(0.02, 1.5, 24)])
"""Sample times of the gas after a pulse, in its time constants; its peak lies in this range."""
SETTLING_PERIODS = 5
"""Simulated periods of a train after settling at the mean power."""


class PulseStimulus(NamedTuple):
    """One pulse at full power on one pixel."""

    pixel: Pixel
    width_s: float


class TrainStimulus(NamedTuple):
    """Steady train at full power."""

    pixel: Pixel
    on_s: float
    off_s: float


FrozenTerms = tuple[tuple[str, tuple[tuple[str, float], ...]], ...]
"""Term → parameter → value, hashable."""


def freeze_terms(terms: Mapping[str, Mapping[str, float]]) -> FrozenTerms:
    """Return terms as a key for the caches."""
    return tuple((key, tuple(values.items())) for key, values in terms.items())


def _build_active_terms(terms: FrozenTerms) -> ActiveTerms:
    return ActiveTerms.from_values({key: dict(values) for key, values in terms})


@lru_cache(maxsize=100_000)
def pulse_rises_k(pulse: PulseStimulus, terms: FrozenTerms) -> tuple[float, float]:
    """Return the absorber's rise at the end of a pulse from the cold state, and the largest gas rise, K."""
    pixel, width_s = pulse
    if not terms:
        theta_k, gamma_k = advance(pixel, 0.0, 0.0, FULL_POWER_W, width_s)
        return theta_k, cooling_peak(pixel, theta_k, gamma_k)[0]
    t_s = width_s + PEAK_TIMES_TAU * pixel.tau_g_s
    drive = np.array([[0.0, width_s, FULL_POWER_W, 0.0]])
    experiment = PixelExperiment(drive, 0, AMBIENT_K, (t_s[:1], t_s, t_s[:0]), full_w=FULL_POWER_W)
    absorber_k, gas_k, _ = simulate_signals(experiment, pixel._replace(kappa_m_per_k=1.0), _build_active_terms(terms))
    return float(absorber_k[0]), float(gas_k.max())


@lru_cache(maxsize=100_000)
def _train_gas_bytes(train: TrainStimulus, terms: FrozenTerms) -> bytes:
    return (_simulated_gas_k(train, terms) if terms else _closed_form_gas_k(train)).tobytes()


def train_gas_k(train: TrainStimulus, terms: FrozenTerms) -> FloatArray:
    """Return the gas rise, K, at PERIOD_SAMPLES + 1 equidistant times of one period of the steady train."""
    return np.frombuffer(_train_gas_bytes(train, terms))


def _closed_form_gas_k(train: TrainStimulus) -> FloatArray:
    pixel, on_s, off_s = train

    start, gate_off_state = _find_steady_state(pixel, FULL_POWER_W, on_s, off_s)

    def gas_k(at_s: float) -> float:
        if at_s <= on_s:
            return advance(pixel, *start, FULL_POWER_W, at_s)[1]
        return advance(pixel, *gate_off_state, 0.0, at_s - on_s)[1]

    return np.array([gas_k(at_s) for at_s in np.linspace(0.0, on_s + off_s, PERIOD_SAMPLES + 1).tolist()])


def _simulated_gas_k(train: TrainStimulus, terms: FrozenTerms) -> FloatArray:
    """Simulate the mean power until it has settled, then the train, starting in mid-pulse where it crosses its mean."""
    pixel, on_s, off_s = train
    period_s = on_s + off_s
    preheat_s = 6.0 * (pixel.tau_s + pixel.tau_g_s) + LONG_PULSE_S
    starts_s = preheat_s + 0.5 * on_s + off_s + period_s * np.arange(SETTLING_PERIODS + 1)
    rows = [(0.0, preheat_s, FULL_POWER_W * on_s / period_s, 0.0), (preheat_s, 0.5 * on_s, FULL_POWER_W, 0.0)]
    rows += [(start_s, on_s, FULL_POWER_W, 0.0) for start_s in starts_s]
    t_s = starts_s[-1] + np.linspace(0.0, period_s, PERIOD_SAMPLES + 1)
    experiment = PixelExperiment(np.array(rows), 0, AMBIENT_K, (t_s[:0], t_s, t_s[:0]), full_w=FULL_POWER_W)
    return simulate_signals(experiment, pixel._replace(kappa_m_per_k=1.0), _build_active_terms(terms))[1]
