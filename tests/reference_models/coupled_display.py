"""Exact thermal state of a display whose walls are coupled, for comparison with the package's models.

    C dθ_i/dt   = ε P_i − (θ_i − w_i)/R                                        θ absorber rise, K
    C_w dw_i/dt = (θ_i − w_i)/R − w_i/R_w − Σ_j (w_i − w_j)/R_x − f_i w_i/R_f  w wall rise, K
    τ_g dγ_i/dt = (θ_i + w_i)/2 − γ_i                                          γ gas rise, K
    z_i = κ γ_i                                                                z displacement, m

j are the neighbours of i, f_i its edges on the frame; resistances and sources are in `surroundings.toml`.

All cells are equal, so the equations decouple in the modes of the lattice, the eigenvectors of the walls' conductances.
Each mode has three amplitudes, which decay exponentially between two events: two coupled motions of absorber and wall,
and the gas. A pulse adds to every mode in proportion to its pixel's share.
"""

from math import exp, expm1, factorial
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.neighbours import Neighbours
from optodrive.physics.nominal_display import TIME_ROUNDING_S, build_kernel_columns
from optodrive.physics.parameters import ParameterSet
from optodrive.physics.pixel import GAS_FRACTION, Pixel, cooling_peak, gas_peak

MIN_RATE_SEPARATION = 1e-8
"""Smallest relative distance of a mode's rate from the gas's; closer rates are moved apart.

The closed form of the gas is singular for equal rates; the error of the rises is of this order.
"""
COEFFICIENTS = tuple(1.0 / factorial(n + 1) for n in range(13, -1, -1))
SERIES_REACH = 0.5
"""Largest argument at which the series with these coefficients has an error below 1e-16."""


class WallParameters(NamedTuple):
    """Surroundings of each cell: wall to ambient, heat capacity of the wall, wall to wall, wall to frame."""

    r_k_per_w: float
    c_j_per_k: float
    side_k_per_w: float
    frame_k_per_w: float

    @classmethod
    def from_parameters(cls, parameters: ParameterSet) -> "WallParameters":
        """Return the values of wall_heating and, if present, lateral_conduction of a parameter set."""
        wall, side = parameters.terms["wall_heating"], parameters.terms.get("lateral_conduction")
        return cls(
            wall["resistance"].value,
            wall["capacity"].value,
            side["resistance"].value if side else np.inf,
            side["frame_resistance"].value if side else np.inf,
        )


class WallPeaks(NamedTuple):
    """Peaks that each pulse [n] causes on its pixel.

    displacement_m: peak from its start to the pixel's next pulse; absorber_k: larger rise at its two ends; wall_k: rise
    of the wall at its end
    """

    displacement_m: FloatArray
    absorber_k: FloatArray
    wall_k: FloatArray


class ModalAmplitudes(NamedTuple):
    """Amplitudes of the modes [p]: absorber rise in the two motions of each mode, and the gas's own part, K."""

    first_k: FloatArray
    second_k: FloatArray
    gas_k: FloatArray


class Modes(NamedTuple):
    """Modes of the display. The first motion of a mode is mostly absorber, the second mostly wall.

    share: [p, p] component of each pixel in each mode. For each motion, all [p]: its rate; rise of wall and gas per
    kelvin of the absorber; rise of the absorber per joule of light. gas_k_per_j: [p] rise of the gas's own amplitude
    per joule of light
    """

    pixel: Pixel
    share: FloatArray
    first_per_s: FloatArray
    second_per_s: FloatArray
    first_wall: FloatArray
    second_wall: FloatArray
    first_gas: FloatArray
    second_gas: FloatArray
    first_k_per_j: FloatArray
    second_k_per_j: FloatArray
    gas_k_per_j: FloatArray
    gas_per_s: float
    first_max_per_s: float
    second_max_per_s: float

    @classmethod
    def diagonalise(cls, pixel: Pixel, walls: WallParameters, neighbours: Neighbours) -> "Modes":
        """Diagonalise a display of equal cells, which takes about a second for 1,511 of them."""
        wall_w_per_k, share = np.linalg.eigh(build_conductances_w_per_k(walls, neighbours))
        first_per_s, second_per_s, tangent = _solve_motions(pixel, walls, wall_w_per_k)
        wall_per_absorber = np.sqrt(pixel.c_j_per_k / walls.c_j_per_k)
        first_wall, second_wall = -tangent * wall_per_absorber, wall_per_absorber / tangent
        first_gas = GAS_FRACTION * (1.0 + first_wall) / (1.0 - first_per_s * pixel.tau_g_s)
        second_gas = GAS_FRACTION * (1.0 + second_wall) / (1.0 - second_per_s * pixel.tau_g_s)
        first_k_per_j = pixel.epsilon / pixel.c_j_per_k / (1.0 + tangent**2)
        second_k_per_j = first_k_per_j * tangent**2
        return cls(
            pixel=pixel,
            share=np.ascontiguousarray(share),
            first_per_s=first_per_s,
            second_per_s=second_per_s,
            first_wall=first_wall,
            second_wall=second_wall,
            first_gas=first_gas,
            second_gas=second_gas,
            first_k_per_j=first_k_per_j,
            second_k_per_j=second_k_per_j,
            gas_k_per_j=-(first_gas * first_k_per_j + second_gas * second_k_per_j),
            gas_per_s=1.0 / pixel.tau_g_s,
            first_max_per_s=float(first_per_s.max()),
            second_max_per_s=float(second_per_s.max()),
        )


def build_conductances_w_per_k(walls: WallParameters, neighbours: Neighbours) -> FloatArray:
    """Return the conductance matrix [p, p]: heat flow out of the wall of a row per kelvin of the wall of a column."""
    pixel, side = np.nonzero(neighbours.indices >= 0)
    matrix = np.zeros((len(neighbours), len(neighbours)))
    matrix[pixel, neighbours.indices[pixel, side]] = -1.0 / walls.side_k_per_w
    np.fill_diagonal(matrix, 1.0 / walls.r_k_per_w + neighbours.frame_edges / walls.frame_k_per_w - matrix.sum(axis=1))
    return matrix


def _solve_motions(
    pixel: Pixel, walls: WallParameters, wall_w_per_k: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the two rates of each mode, [p] 1/s, and the tangent of the rotation that decouples them, [p].

    In √C θ and √C_w w the two equations are symmetric, and one Jacobi rotation makes them independent.
    """
    absorber_per_s = 1.0 / pixel.tau_s
    wall_per_s = (1.0 / pixel.r_k_per_w + wall_w_per_k) / walls.c_j_per_k
    between_per_s = absorber_per_s * np.sqrt(pixel.c_j_per_k / walls.c_j_per_k)
    halves = (absorber_per_s - wall_per_s) / (2.0 * between_per_s)
    tangent = np.copysign(1.0, halves) / (np.abs(halves) + np.hypot(1.0, halves))
    rates_per_s = np.stack([absorber_per_s + tangent * between_per_s, wall_per_s - tangent * between_per_s])
    # The product of both rates gives the smaller one without cancellation.
    larger_per_s = rates_per_s.max(axis=0)
    smaller_per_s = absorber_per_s * wall_w_per_k / walls.c_j_per_k / larger_per_s
    rates_per_s = _separate_rates(np.where(rates_per_s < larger_per_s, smaller_per_s, rates_per_s), 1.0 / pixel.tau_g_s)
    return rates_per_s[0], rates_per_s[1], tangent


def _separate_rates(rate_per_s: FloatArray, gas_per_s: float) -> FloatArray:
    meets = np.abs(rate_per_s - gas_per_s) < MIN_RATE_SEPARATION * gas_per_s
    return np.where(meets, (1.0 - MIN_RATE_SEPARATION) * gas_per_s, rate_per_s)


class CoupledDisplay:
    """Mutable thermal state of a display of equal cells with coupled walls. All pixels share one time."""

    def __init__(self, modes: Modes, at_s: float = 0.0) -> None:
        self._modes = modes
        self._at_s = np.array([at_s])
        self._now = _zero_amplitudes(len(modes.share))

    def apply_pulses(self, pixel: IntArray, start_s: FloatArray, width_s: FloatArray, power_w: FloatArray) -> WallPeaks:
        """Apply pulses in order of time, all [n], power_w the mean incident power. Return their peaks.

        Raises ValueError for a pulse that starts before the last event; the pulses before it remain applied.
        """
        columns = build_kernel_columns(len(self._modes.share), pixel, start_s, width_s, power_w)
        peaks = WallPeaks(*np.zeros((3, len(pixel))))
        done = _apply_pulses(self._modes, self._now, self._at_s, *columns, *peaks)
        if done < len(pixel):
            raise ValueError(f"the display was advanced to {self._at_s[0]} s, {start_s[done]} s lies before it")
        return peaks

    def rises_k(self, at_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the rises of absorber, wall and gas, K, each [p], with the gate off until at_s."""
        off_s = at_s - float(self._at_s[0])
        if off_s < -TIME_ROUNDING_S:
            raise ValueError(f"the display was advanced to {self._at_s[0]} s, {at_s} s lies before it")
        modes, then = self._modes, _zero_amplitudes(len(self._modes.share))
        _advance(modes, self._now, then, 0, 0.0, max(0.0, off_s))
        wall_k = modes.first_wall * then.first_k + modes.second_wall * then.second_k
        gas_k = modes.first_gas * then.first_k + modes.second_gas * then.second_k + then.gas_k
        absorber_k = then.first_k + then.second_k
        return modes.share @ absorber_k, modes.share @ wall_k, modes.share @ gas_k


def _zero_amplitudes(modes: int) -> ModalAmplitudes:
    return ModalAmplitudes(np.zeros(modes), np.zeros(modes), np.zeros(modes))


@array_kernel
def _apply_pulses(
    modes: Modes,
    now: ModalAmplitudes,
    at_s: FloatArray,
    pixel: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    power_w: FloatArray,
    peak_m: FloatArray,
    peak_k: FloatArray,
    wall_k: FloatArray,
) -> int:
    """Apply the pulses [n] and fill in their peaks [n]. Return the number of pulses before one out of order.

    The time of the gas peak assumes a constant wall, the value at that time uses all modes: near a peak, a small error
    of time causes a much smaller one of height. For walls a thousand times slower than the pixel, as in the laminate,
    the peak is less than 1e-6 of itself too low; for walls as fast as the gas, less than 1e-3. Light on other pixels
    before the peak is neglected, because its heat passes two walls.
    """
    one = modes.pixel
    spare = ModalAmplitudes(np.empty_like(now.gas_k), np.empty_like(now.gas_k), np.empty_like(now.gas_k))
    next_s = _next_on_pixel(len(now.gas_k), pixel, start_s)
    for row in range(len(pixel)):
        i, on_w, on_s = pixel[row], power_w[row], width_s[row]
        if start_s[row] - at_s[0] < -TIME_ROUNDING_S:
            return row
        _advance(modes, now, now, i, 0.0, max(0.0, start_s[row] - at_s[0]))
        before_k, wall_rise_k, start_k = _read_rises(modes, now, i)
        turn_s = gas_peak(one, before_k - wall_rise_k, start_k - wall_rise_k, on_w, on_s)[1]
        peak_gas_k = start_k
        if 0.0 < turn_s < on_s:
            _advance(modes, now, spare, i, on_w, turn_s)
            peak_gas_k = max(peak_gas_k, _read_rises(modes, spare, i)[2])
        _advance(modes, now, now, i, on_w, on_s)
        at_s[0] = start_s[row] + on_s
        after_k, wall_rise_k, end_k = _read_rises(modes, now, i)
        turn_s = cooling_peak(one, after_k - wall_rise_k, end_k - wall_rise_k, max(0.0, next_s[row] - at_s[0]))[1]
        peak_gas_k = max(peak_gas_k, end_k)
        if turn_s > 0.0:
            _advance(modes, now, spare, i, 0.0, turn_s)
            peak_gas_k = max(peak_gas_k, _read_rises(modes, spare, i)[2])
        peak_m[row] = one.kappa_m_per_k * peak_gas_k
        peak_k[row] = max(before_k, after_k)
        wall_k[row] = wall_rise_k
    return len(pixel)


@array_kernel
def _next_on_pixel(pixels: int, pixel: IntArray, start_s: FloatArray) -> FloatArray:
    """Return the start of the next pulse on the pixel of each pulse, [n], infinite for its last one."""
    coming_s = np.full(pixels, np.inf)
    next_s = np.empty(len(pixel))
    for row in range(len(pixel) - 1, -1, -1):
        next_s[row] = coming_s[pixel[row]]
        coming_s[pixel[row]] = start_s[row]
    return next_s


@kernel
def _advance(
    modes: Modes, before: ModalAmplitudes, after: ModalAmplitudes, pixel: int, power_w: float, time_s: float
) -> None:
    """Advance the amplitudes by time_s at constant power on one pixel. before and after may be the same."""
    share = modes.share[pixel]
    light_j = power_w * time_s
    mean, left = _decay(modes.first_per_s, modes.first_max_per_s, time_s)
    _advance_motion(before.first_k, after.first_k, left, light_j, share, modes.first_k_per_j, mean)
    mean, left = _decay(modes.second_per_s, modes.second_max_per_s, time_s)
    _advance_motion(before.second_k, after.second_k, left, light_j, share, modes.second_k_per_j, mean)
    gas_left = exp(-modes.gas_per_s * time_s)
    gas_light_j = power_w * -expm1(-modes.gas_per_s * time_s) / modes.gas_per_s
    for k in range(len(share)):
        after.gas_k[k] = before.gas_k[k] * gas_left + gas_light_j * share[k] * modes.gas_k_per_j[k]


@kernel
def _advance_motion(
    before_k: FloatArray,
    after_k: FloatArray,
    left: FloatArray,
    light_j: float,
    share: FloatArray,
    k_per_j: FloatArray,
    mean: FloatArray,
) -> None:
    """Advance one motion of all modes. The compiler vectorises this loop only with few arrays."""
    for k in range(len(share)):
        after_k[k] = before_k[k] * left[k] + light_j * share[k] * k_per_j[k] * mean[k]


@array_kernel
def _decay(rate_per_s: FloatArray, max_per_s: float, time_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean of e^(−rate t) over the time and its value at the end, each [p].

    The series of (1 − e^(−x))/x covers a fraction of the time, which is doubled as often as necessary: it has no
    branches, so that the loop vectorises, and it is exact for arbitrarily long pauses.
    """
    doublings, part_s = 0, time_s
    while max_per_s * part_s > SERIES_REACH:
        doublings, part_s = doublings + 1, 0.5 * part_s
    mean, left = np.empty_like(rate_per_s), np.empty_like(rate_per_s)
    for k in range(len(rate_per_s)):
        x = rate_per_s[k] * part_s
        mean[k] = _series(x)
        left[k] = 1.0 - x * mean[k]
    for _ in range(doublings):
        for k in range(len(rate_per_s)):
            mean[k] *= 0.5 * (1.0 + left[k])
            left[k] *= left[k]
    return mean, left


@kernel
def _series(x: float) -> float:
    """Return (1 − e^(−x))/x = Σ (−x)^n/(n+1)!."""
    total = 0.0
    for coefficient in COEFFICIENTS:
        total = coefficient - x * total
    return total


@kernel
def _read_rises(modes: Modes, heat: ModalAmplitudes, pixel: int) -> tuple[float, float, float]:
    """Return the rises of absorber, wall and gas of one pixel, K."""
    absorber_k, wall_k, gas_k = 0.0, 0.0, 0.0
    share = modes.share[pixel]
    for k in range(len(share)):
        first_k, second_k = share[k] * heat.first_k[k], share[k] * heat.second_k[k]
        absorber_k += first_k + second_k
        wall_k += modes.first_wall[k] * first_k + modes.second_wall[k] * second_k
        gas_k += modes.first_gas[k] * first_k + modes.second_gas[k] * second_k + share[k] * heat.gas_k[k]
    return absorber_k, wall_k, gas_k
