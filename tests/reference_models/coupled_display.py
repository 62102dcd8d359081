"""A whole display whose cells warm each other through their walls: exact, pulse by pulse.

    C dθ_i/dt   = ε P_i − (θ_i − w_i)/R                                        θ absorber rise, K
    C_w dw_i/dt = (θ_i − w_i)/R − w_i/R_w − Σ_j (w_i − w_j)/R_x − f_i w_i/R_f  w wall rise, K
    τ_g dγ_i/dt = (θ_i + w_i)/2 − γ_i                                          γ gas rise, K
    z_i = κ γ_i                                                                z displacement, m

j are the pixels beside i, f_i its edges against the frame; resistances and sources in `surroundings.toml`.

Every cell is the same, so the equations fall apart into the modes of the lattice: the eigenvectors of the walls'
conductances. A mode is a cell by itself, with two rates of its own and the gas's, and between two events each of its
three amplitudes decays by its own exponential. A pulse adds to all modes, in the measure of its pixel in each.
"""

from math import exp, expm1, factorial
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import vector_kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.neighbours import Neighbours
from optodrive.physics.nominal_display import TIME_ROUNDING_S, build_kernel_columns
from optodrive.physics.parameters import ParameterSet
from optodrive.physics.pixel import GAS_FRACTION, Pixel, cooling_peak, gas_peak

MIN_RATE_SEPARATION = 1e-8
"""A mode whose rate meets the gas's is moved off by this share, or its gas would need a form of its own.

Rises are then wrong by about as little: less by the rate, and no more by the digits that near rates lose.
"""
COEFFICIENTS = tuple(1.0 / factorial(n + 1) for n in range(13, -1, -1))
SERIES_REACH = 0.5
"""The series of these coefficients leaves out less than 1e-16 up to here."""


class WallParameters(NamedTuple):
    """What surrounds each cell: wall to ambient, the wall's heat capacity, wall to wall beside it, wall to frame."""

    r_k_per_w: float
    c_j_per_k: float
    side_k_per_w: float
    frame_k_per_w: float

    @classmethod
    def from_parameters(cls, parameters: ParameterSet) -> "WallParameters":
        """The terms wall_heating and, where there is one, lateral_conduction of a parameter set."""
        wall, side = parameters.terms["wall_heating"], parameters.terms.get("lateral_conduction")
        return cls(
            wall["resistance"].value,
            wall["capacity"].value,
            side["resistance"].value if side else np.inf,
            side["frame_resistance"].value if side else np.inf,
        )


class WallPeaks(NamedTuple):
    """What each pulse [n] does to its pixel.

    displacement_m: the largest from its start to the pixel's next pulse; absorber_k: the larger rise of its two ends;
    wall_k: the wall's rise at its end.
    """

    displacement_m: FloatArray
    absorber_k: FloatArray
    wall_k: FloatArray


class ModalAmplitudes(NamedTuple):
    """Amplitudes [p], a mode each: the absorber's rise in the mode's two motions, and the gas's own, K."""

    first_k: FloatArray
    second_k: FloatArray
    gas_k: FloatArray


class Modes(NamedTuple):
    """The display's modes. first, second: the two motions of a mode, the first mostly absorber, the second mostly wall.

    share: [p, p] of pixel in mode. Of each motion, all [p]: its rate; what wall and gas rise with a kelvin of the
    absorber; what the absorber rises by a joule of light. gas_k_per_j: [p] the same for the gas's own amplitude.
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
        """Diagonalise a display of equal cells; takes a second or so for 1,511, once for any number of simulations."""
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
    """[p, p] heat that leaves the wall of a row for each kelvin of the wall of a column."""
    pixel, side = np.nonzero(neighbours.indices >= 0)
    matrix = np.zeros((len(neighbours), len(neighbours)))
    matrix[pixel, neighbours.indices[pixel, side]] = -1.0 / walls.side_k_per_w
    np.fill_diagonal(matrix, 1.0 / walls.r_k_per_w + neighbours.frame_edges / walls.frame_k_per_w - matrix.sum(axis=1))
    return matrix


def _solve_motions(
    pixel: Pixel, walls: WallParameters, wall_w_per_k: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Each mode's two rates, [p] 1/s, and the tangent between its motions and absorber and wall by themselves, [p].

    In √C θ and √C_w w the two equations are symmetric, and one Jacobi rotation makes them independent.
    """
    absorber_per_s = 1.0 / pixel.tau_s
    wall_per_s = (1.0 / pixel.r_k_per_w + wall_w_per_k) / walls.c_j_per_k
    between_per_s = absorber_per_s * np.sqrt(pixel.c_j_per_k / walls.c_j_per_k)
    halves = (absorber_per_s - wall_per_s) / (2.0 * between_per_s)
    tangent = np.copysign(1.0, halves) / (np.abs(halves) + np.hypot(1.0, halves))
    rates_per_s = np.stack([absorber_per_s + tangent * between_per_s, wall_per_s - tangent * between_per_s])
    # The smaller from the product of both, which has lost no digits.
    larger_per_s = rates_per_s.max(axis=0)
    smaller_per_s = absorber_per_s * wall_w_per_k / walls.c_j_per_k / larger_per_s
    rates_per_s = _separate_rates(np.where(rates_per_s < larger_per_s, smaller_per_s, rates_per_s), 1.0 / pixel.tau_g_s)
    return rates_per_s[0], rates_per_s[1], tangent


def _separate_rates(rate_per_s: FloatArray, gas_per_s: float) -> FloatArray:
    meets = np.abs(rate_per_s - gas_per_s) < MIN_RATE_SEPARATION * gas_per_s
    return np.where(meets, (1.0 - MIN_RATE_SEPARATION) * gas_per_s, rate_per_s)


class CoupledDisplay:
    """The heat of a display of equal cells with walls, from rest; mutable. All pixels share one time."""

    def __init__(self, modes: Modes, at_s: float = 0.0) -> None:
        self._modes = modes
        self._at_s = np.array([at_s])
        self._now = _zero_amplitudes(len(modes.share))

    def apply_pulses(self, pixel: IntArray, start_s: FloatArray, width_s: FloatArray, power_w: FloatArray) -> WallPeaks:
        """Light pixels one after the other; all [n], in order of time, power the mean incident one.

        ValueError for a pulse that starts before the last event; those before it have been.
        """
        columns = build_kernel_columns(len(self._modes.share), pixel, start_s, width_s, power_w)
        peaks = WallPeaks(*np.zeros((3, len(pixel))))
        done = _apply_pulses(self._modes, self._now, self._at_s, *columns, *peaks)
        if done < len(pixel):
            raise ValueError(f"the display was advanced to {self._at_s[0]} s, {start_s[done]} s lies before it")
        return peaks

    def rises_k(self, at_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rises of absorber, wall and gas, K, each [p], left dark until at_s; ValueError for a time before the last."""
        dark_s = at_s - float(self._at_s[0])
        if dark_s < -TIME_ROUNDING_S:
            raise ValueError(f"the display was advanced to {self._at_s[0]} s, {at_s} s lies before it")
        modes, then = self._modes, _zero_amplitudes(len(self._modes.share))
        _advance(modes, self._now, then, 0, 0.0, max(0.0, dark_s))
        wall_k = modes.first_wall * then.first_k + modes.second_wall * then.second_k
        gas_k = modes.first_gas * then.first_k + modes.second_gas * then.second_k + then.gas_k
        absorber_k = then.first_k + then.second_k
        return modes.share @ absorber_k, modes.share @ wall_k, modes.share @ gas_k


def _zero_amplitudes(modes: int) -> ModalAmplitudes:
    return ModalAmplitudes(np.zeros(modes), np.zeros(modes), np.zeros(modes))


@vector_kernel
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
    """Heat by the pulses [n], fill in what they do [n]; the number of pulses that did not come too early.

    When the gas turns is told by the pixel with its wall held, what it is then by all modes: at a turn, a small error
    of time is a far smaller one of height. For walls a thousand times as slow as the pixel, as the laminate's, the peak
    lies less than 1e-6 of itself too low; for walls as quick as the gas, less than 1e-3. Light on other pixels before
    the turn is left out of it: it comes through two walls.
    """
    one = modes.pixel
    spare = ModalAmplitudes(np.empty_like(now.gas_k), np.empty_like(now.gas_k), np.empty_like(now.gas_k))
    next_s = _next_on_pixel(len(now.gas_k), pixel, start_s)
    for row in range(len(pixel)):
        i, lit_w, lit_s = pixel[row], power_w[row], width_s[row]
        if start_s[row] - at_s[0] < -TIME_ROUNDING_S:
            return row
        _advance(modes, now, now, i, 0.0, max(0.0, start_s[row] - at_s[0]))
        before_k, held_k, least_k = _read_rises(modes, now, i)
        turn_s = gas_peak(one, before_k - held_k, least_k - held_k, lit_w, lit_s)[1]
        most_k = least_k
        if 0.0 < turn_s < lit_s:
            _advance(modes, now, spare, i, lit_w, turn_s)
            most_k = max(most_k, _read_rises(modes, spare, i)[2])
        _advance(modes, now, now, i, lit_w, lit_s)
        at_s[0] = start_s[row] + lit_s
        after_k, held_k, end_k = _read_rises(modes, now, i)
        turn_s = cooling_peak(one, after_k - held_k, end_k - held_k, max(0.0, next_s[row] - at_s[0]))[1]
        most_k = max(most_k, end_k)
        if turn_s > 0.0:
            _advance(modes, now, spare, i, 0.0, turn_s)
            most_k = max(most_k, _read_rises(modes, spare, i)[2])
        peak_m[row] = one.kappa_m_per_k * most_k
        peak_k[row] = max(before_k, after_k)
        wall_k[row] = held_k
    return len(pixel)


@vector_kernel
def _next_on_pixel(pixels: int, pixel: IntArray, start_s: FloatArray) -> FloatArray:
    """[n] when the pixel of each pulse is lit again; infinite for its last."""
    coming_s = np.full(pixels, np.inf)
    next_s = np.empty(len(pixel))
    for row in range(len(pixel) - 1, -1, -1):
        next_s[row] = coming_s[pixel[row]]
        coming_s[pixel[row]] = start_s[row]
    return next_s


@vector_kernel
def _advance(
    modes: Modes, before: ModalAmplitudes, after: ModalAmplitudes, pixel: int, power_w: float, time_s: float
) -> None:
    """Amplitudes after time_s at constant power on one pixel; before and after may be the same."""
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


@vector_kernel
def _advance_motion(
    before_k: FloatArray,
    after_k: FloatArray,
    left: FloatArray,
    light_j: float,
    share: FloatArray,
    k_per_j: FloatArray,
    mean: FloatArray,
) -> None:
    """One motion of all modes. A loop apart: with more arrays the compiler does not see that it may take several k."""
    for k in range(len(share)):
        after_k[k] = before_k[k] * left[k] + light_j * share[k] * k_per_j[k] * mean[k]


@vector_kernel
def _decay(rate_per_s: FloatArray, most_per_s: float, time_s: float) -> tuple[FloatArray, FloatArray]:
    """Of e^(−rate t): the mean over the time, and what is left at its end, each [p].

    By the series of (1 − e^(−x))/x for a part of the time, doubled as often as needed: it has no branches, so the
    processor takes several modes at once, and it is exact for a pause without end.
    """
    doublings, part_s = 0, time_s
    while most_per_s * part_s > SERIES_REACH:
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


@vector_kernel
def _series(x: float) -> float:
    """(1 − e^(−x))/x = Σ (−x)^n/(n+1)!."""
    total = 0.0
    for coefficient in COEFFICIENTS:
        total = coefficient - x * total
    return total


@vector_kernel
def _read_rises(modes: Modes, heat: ModalAmplitudes, pixel: int) -> tuple[float, float, float]:
    """Rises of absorber, wall and gas of one pixel, K."""
    absorber_k, wall_k, gas_k = 0.0, 0.0, 0.0
    share = modes.share[pixel]
    for k in range(len(share)):
        first_k, second_k = share[k] * heat.first_k[k], share[k] * heat.second_k[k]
        absorber_k += first_k + second_k
        wall_k += modes.first_wall[k] * first_k + modes.second_wall[k] * second_k
        gas_k += modes.first_gas[k] * first_k + modes.second_gas[k] * second_k + share[k] * heat.gas_k[k]
    return absorber_k, wall_k, gas_k
