"""Closed form of the nominal pixel, exact for piecewise-constant power.

    C dθ/dt   = ε P − θ/R        θ absorber rise, K      (the paper's Text S1, uncoupled form)
    τ_g dγ/dt = θ/2 − γ          γ gas rise, K
    z = κ γ,  F = φ γ

Everything is written with a = 1/(RC), b = 1/τ_g and the divided difference
D(t) = (e^(−at) − e^(−bt)) / (b − a), which stays exact as τ_g → RC. All functions are kernels.
"""

from math import exp, expm1, log1p
from typing import NamedTuple

from optodrive.core.kernels import kernel

GAS_FRACTION = 0.5
"""Steady gas rise over absorber rise: the air conducts equally to absorber and wall (Text S1)."""


class Pixel(NamedTuple):
    """Nominal parameters of one pixel.

    r_k_per_w: absorber to wall; c_j_per_k: absorber heat capacity; epsilon: absorbed fraction of incident light;
    tau_g_s: gas lag; kappa_m_per_k: displacement, and phi_n_per_k: blocked force, per kelvin of gas rise.
    """

    r_k_per_w: float
    c_j_per_k: float
    epsilon: float
    tau_g_s: float
    kappa_m_per_k: float
    phi_n_per_k: float

    @property
    def tau_s(self) -> float:
        """Absorber relaxation time RC, s."""
        return self.r_k_per_w * self.c_j_per_k


@kernel
def divided_difference(a: float, b: float, t_s: float) -> float:
    """Return (e^(−a t) − e^(−b t)) / (b − a), s, which is t e^(−a t) for a = b."""
    if b < a:
        a, b = b, a  # the expression is symmetric, and e^(+x) would overflow after seconds of gate off
    x = (b - a) * t_s
    # Two terms of the series: the difference of nearly equal exponentials would lose all digits.
    if x < 1e-9:
        return t_s * exp(-a * t_s) * (1.0 - 0.5 * x)
    return exp(-a * t_s) * -expm1(-x) / (b - a)


@kernel
def advance(pixel: Pixel, theta_k: float, gamma_k: float, power_w: float, t_s: float) -> tuple[float, float]:
    """Return absorber and gas rise, K, after `t_s` at constant incident power, W."""
    a, b = 1.0 / (pixel.r_k_per_w * pixel.c_j_per_k), 1.0 / pixel.tau_g_s
    steady_k = pixel.epsilon * power_w * pixel.r_k_per_w
    excess_k = theta_k - steady_k
    theta_end_k = steady_k + excess_k * exp(-a * t_s)
    gas_steady_k = GAS_FRACTION * steady_k
    gamma_end_k = (
        gas_steady_k
        + (gamma_k - gas_steady_k) * exp(-b * t_s)
        + GAS_FRACTION * b * excess_k * divided_difference(a, b, t_s)
    )
    return theta_end_k, gamma_end_k


@kernel
def gas_peak(pixel: Pixel, theta_k: float, gamma_k: float, power_w: float, within_s: float) -> tuple[float, float]:
    """Return the peak gas rise, K, and its time, s, within `within_s` at constant incident power.

    With θ' and γ' the rises relative to their steady values, the gas rise has its extremum where θ'/2 = γ', at
    t = log1p((b − a) u)/(b − a) with u = (1 − 2γ'/θ')/a. It is a maximum if the absorber cools, θ' > 0.
    """
    a, b = 1.0 / (pixel.r_k_per_w * pixel.c_j_per_k), 1.0 / pixel.tau_g_s
    steady_k = pixel.epsilon * power_w * pixel.r_k_per_w
    drive_k = GAS_FRACTION * (theta_k - steady_k)
    lag_k = gamma_k - GAS_FRACTION * steady_k
    turn_s = within_s
    if lag_k >= drive_k >= 0.0:  # the gas falls towards a value that does not rise
        return gamma_k, 0.0
    if drive_k > 0.0:
        u_s = (1.0 - lag_k / drive_k) / a
        x = (b - a) * u_s
        if abs(x) < 1e-12:
            turn_s = u_s
        # Below −1 the logarithm has no value: the gas rises until within_s, and turns later or never.
        elif x > -1.0:
            turn_s = log1p(x) / (b - a)
    turn_s = min(max(turn_s, 0.0), within_s)
    if turn_s == 0.0:
        return gamma_k, 0.0
    peak_k = advance(pixel, theta_k, gamma_k, power_w, turn_s)[1]
    # Rounding may put the extremum a last digit below the begin.
    return (peak_k, turn_s) if peak_k > gamma_k else (gamma_k, 0.0)


@kernel
def cooling_peak(pixel: Pixel, theta_k: float, gamma_k: float, within_s: float = float("inf")) -> tuple[float, float]:
    """Return the peak gas rise, K, and its time, s, with the gate off."""
    if theta_k <= 0.0:
        return gamma_k, 0.0
    return gas_peak(pixel, theta_k, gamma_k, 0.0, within_s)
