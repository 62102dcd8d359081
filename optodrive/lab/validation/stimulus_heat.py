"""Absorber and gas under the paper's stimuli: in closed form, and simulated where a cause has none."""

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.validation.extended_outcomes import AMBIENT_K
from optodrive.lab.validation.paper_outcomes import FULL_W, LONG_S
from optodrive.physics.pixel import Pixel, advance, cooling_peak
from optodrive.physics.pixel_ode import Active, Scene, observe

SAMPLES = 48
"""Of a period of a steady train."""
TAIL = np.concatenate([[0.0], np.geomspace(0.02, 1.5, 24)])
"""When a simulated gas is looked at after a pulse, in its own time constants: its peak lies there."""
SETTLE = 5
"""Periods of a simulated train after the mean power has settled."""


class Pulse(NamedTuple):
    """One pulse at full power on one pixel."""

    pixel: Pixel
    width_s: float


class Train(NamedTuple):
    """A steady train at full power."""

    pixel: Pixel
    lit_s: float
    dark_s: float


Terms = tuple[tuple[str, tuple[tuple[str, float], ...]], ...]
"""Term → parameter → value, hashable."""


def frozen(terms: Mapping[str, Mapping[str, float]]) -> Terms:
    """As a key of the caches."""
    return tuple((key, tuple(own.items())) for key, own in terms.items())


def _active(terms: Terms) -> Active:
    return Active.of({key: dict(own) for key, own in terms})


@lru_cache(maxsize=100_000)
def pulse_rises_k(pulse: Pulse, terms: Terms) -> tuple[float, float]:
    """Absorber's rise at the end of a pulse from rest, and the gas's largest rise, K."""
    pixel, width_s = pulse
    if not terms:
        theta_k, gamma_k = advance(pixel, 0.0, 0.0, FULL_W, width_s)
        return theta_k, cooling_peak(pixel, theta_k, gamma_k)[0]
    t_s = width_s + TAIL * pixel.tau_g_s
    light = np.array([[0.0, width_s, FULL_W, 0.0]])
    scene = Scene(light, 0, AMBIENT_K, (t_s[:1], t_s, t_s[:0]), full_w=FULL_W)
    absorber_k, gas_k, _ = observe(scene, pixel._replace(kappa_m_per_k=1.0), _active(terms))
    return float(absorber_k[0]), float(gas_k.max())


@lru_cache(maxsize=100_000)
def _train_gas_k(train: Train, terms: Terms) -> bytes:
    return (_simulated_k(train, terms) if terms else _closed_k(train)).tobytes()


def train_gas_k(train: Train, terms: Terms) -> FloatArray:
    """The gas's rise, K, at SAMPLES + 1 equal steps of one period of the steady train."""
    return np.frombuffer(_train_gas_k(train, terms))


def _closed_k(train: Train) -> FloatArray:
    pixel, lit_s, dark_s = train

    def period(theta_k: float, gamma_k: float) -> FloatArray:
        lit = advance(pixel, theta_k, gamma_k, FULL_W, lit_s)
        return np.array(advance(pixel, *lit, 0.0, dark_s))

    # A period maps states linearly, so the state that it maps to itself solves two equations.
    offset = period(0.0, 0.0)
    matrix = np.stack([period(1.0, 0.0) - offset, period(0.0, 1.0) - offset], axis=1)
    state = np.linalg.solve(np.eye(2) - matrix, offset)
    start = (float(state[0]), float(state[1]))
    lit = advance(pixel, *start, FULL_W, lit_s)

    def gas_k(at_s: float) -> float:
        after = advance(pixel, *start, FULL_W, at_s) if at_s <= lit_s else advance(pixel, *lit, 0.0, at_s - lit_s)
        return after[1]

    return np.array([gas_k(at_s) for at_s in np.linspace(0.0, lit_s + dark_s, SAMPLES + 1).tolist()])


def _simulated_k(train: Train, terms: Terms) -> FloatArray:
    """The mean power first, until it has settled; then the train, begun in mid-pulse, where it crosses its mean."""
    pixel, lit_s, dark_s = train
    period_s = lit_s + dark_s
    warm_s = 6.0 * (pixel.tau_s + pixel.tau_g_s) + LONG_S
    starts_s = warm_s + 0.5 * lit_s + dark_s + period_s * np.arange(SETTLE + 1)
    rows = [(0.0, warm_s, FULL_W * lit_s / period_s, 0.0), (warm_s, 0.5 * lit_s, FULL_W, 0.0)]
    rows += [(start_s, lit_s, FULL_W, 0.0) for start_s in starts_s]
    t_s = starts_s[-1] + np.linspace(0.0, period_s, SAMPLES + 1)
    scene = Scene(np.array(rows), 0, AMBIENT_K, (t_s[:0], t_s, t_s[:0]), full_w=FULL_W)
    return observe(scene, pixel._replace(kappa_m_per_k=1.0), _active(terms))[1]
