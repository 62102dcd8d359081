"""Gas response to the paper's stimuli: one pulse, the shortest pulse to a height, a steady train."""

from dataclasses import dataclass

from optodrive.physics.pixel import GAS_FRACTION, Pixel, advance, cooling_peak, gas_peak

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
    theta_k = gamma_k = 0.0
    period_s = width_s + gap_s
    memory_s = pixel.tau_s + pixel.tau_g_s
    for _ in range(1 + int(40.0 * memory_s / period_s)):
        gate_off_state = advance(pixel, theta_k, gamma_k, power_w, width_s)
        theta_k, gamma_k = advance(pixel, *gate_off_state, 0.0, gap_s)
    max_k = max(
        gas_peak(pixel, theta_k, gamma_k, power_w, width_s)[0],
        cooling_peak(pixel, *gate_off_state, gap_s)[0],
    )
    # With the gate off the gas has no minimum in the interior. The equations are linear, so the minimum during the
    # pulse is the maximum of the negated motion.
    min_k = -gas_peak(pixel, -theta_k, -gamma_k, -power_w, width_s)[0]
    mean_k = GAS_FRACTION * pixel.epsilon * pixel.r_k_per_w * power_w * width_s / period_s
    return SteadyTrain(min_k, max_k, mean_k)
