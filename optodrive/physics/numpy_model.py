"""The nominal pixel and any set of terms, as rates of change: [p] pixels, or as many variants of one, side by side.

C dθ/dt = ε P − (θ − w) / R,   τ_g dγ/dt = (θ + w)/2 − γ,   and what the terms add.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.device.neighbours import Neighbours
from optodrive.physics.parameters import ParameterSet, PixelArray
from optodrive.physics.pixel import GAS_FRACTION
from optodrive.physics.term import HeatFlows, StateView, Term, TermValues
from optodrive.physics.terms import check_requirements, find_term

STEPS = 20
"""Steps of the fourth order in the quickest time constant: errors of 1e-7 of a rise."""
ITERATIONS = 30
"""Of the search for the quickest exchange: it finds the rate from below, to a few per cent."""


class StateRates(NamedTuple):
    """state_per_s: [s, p]; absorbed_w, left_w: [p] into the absorbers, and to ambient for good."""

    state_per_s: FloatArray
    absorbed_w: FloatArray
    left_w: FloatArray


class Drive(NamedTuple):
    """Light from start_s on, until the next one: power_w [p], incident."""

    start_s: float
    power_w: FloatArray


@dataclass(frozen=True, eq=False)
class ModelTrace:
    """rise_k: state → [m, p]; displacement_m, force_n: [m, p]; absorbed_j, left_j, stored_j: [m] over all pixels."""

    t_s: FloatArray
    rise_k: Mapping[str, FloatArray]
    displacement_m: FloatArray
    force_n: FloatArray
    absorbed_j: FloatArray
    left_j: FloatArray
    stored_j: FloatArray


class Model:
    """Nominal parameters [p] plus terms. values: the terms' parameters, term → name → SI value.

    Raises InputError for a term that is not known, lacks one it builds on, or has not its parameters and no others.
    """

    def __init__(
        self,
        pixels: PixelArray,
        values: Mapping[str, TermValues],
        ambient_k: float,
        neighbours: Neighbours | None = None,
    ) -> None:
        self.pixels = pixels
        self.ambient_k = ambient_k
        self._neighbours = neighbours
        self._terms: list[tuple[Term, TermValues]] = [
            (find_term(f"terms.{key}", key, values[key]), values[key]) for key in values
        ]
        check_requirements("terms", values)
        for key in values:
            if not find_term(f"terms.{key}", key, values[key]).is_display_term:
                raise InputError(f"terms.{key}", key, "a term that the model of a whole display knows")
        self._capacity_j_per_k: dict[str, FloatArray] = {"absorber_k": pixels.c_j_per_k}
        for term, own in self._terms:
            for node, name in term.heat_nodes.items():
                self._capacity_j_per_k[node] = np.full(len(pixels), own[name])
        followers = [name for term, _ in self._terms for name in term.followers]
        self.states = ("absorber_k", "gas_k", *list(self._capacity_j_per_k)[1:], *followers)

    @classmethod
    def from_parameters(
        cls, parameters: ParameterSet, pixels: PixelArray, ambient_k: float, neighbours: Neighbours | None = None
    ) -> "Model":
        """The model of a parameter set."""
        values = {key: {name: item.value for name, item in term.items()} for key, term in parameters.terms.items()}
        return cls(pixels, values, ambient_k, neighbours)

    def cold_states(self) -> FloatArray:
        """[s, p] zeros."""
        return np.zeros((len(self.states), len(self.pixels)))

    def _view(self, state_k: FloatArray) -> StateView:
        return StateView(dict(zip(self.states, state_k, strict=True)), self.ambient_k, self._neighbours)

    def rates(self, state_k: FloatArray, power_w: FloatArray) -> StateRates:
        """Rates of change of states [s, p] under incident power [p]."""
        view, pixels = self._view(state_k), self.pixels
        absorber_k, gas_k, wall_k = state_k[0], state_k[1], view.wall_k()
        bridge = pixels.r_k_per_w
        for term, own in self._terms:
            bridge = term.bridge_k_per_w(own, view, bridge)
        absorbed_w = pixels.epsilon * power_w
        flows = HeatFlows({"absorber_k": absorbed_w}, np.zeros(len(pixels)))
        wall = "wall_k" if "wall_k" in self._capacity_j_per_k else None
        flows.add_flow("absorber_k", wall, (absorber_k - wall_k) / bridge)
        for term, own in self._terms:
            term.add_flows(own, view, flows)
        moves = {name: flows.into_w[name] / capacity for name, capacity in self._capacity_j_per_k.items()}
        moves["gas_k"] = (GAS_FRACTION * (absorber_k + wall_k) - gas_k) / pixels.tau_g_s
        for term, own in self._terms:
            moves |= term.rates_k_per_s(own, view)
        return StateRates(np.stack([moves[name] for name in self.states]), absorbed_w, np.asarray(flows.lost_w))

    def outputs(self, state_k: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacement, m, and blocked force, N, of states [s, p] or [s, m, p]: the same without s."""
        view, pixels = self._view(state_k), self.pixels
        displacement_m = pixels.kappa_m_per_k * view.rise_k["gas_k"]
        force_n = pixels.phi_n_per_k * view.rise_k["gas_k"]
        for term, own in self._terms:
            displacement_m = term.displacement_m(own, view, displacement_m)
            force_n = term.force_n(own, view, force_n)
        return displacement_m, force_n

    def stored_j(self, state_k: FloatArray) -> float:
        """Heat above ambient in all nodes, J."""
        rises = dict(zip(self.states, state_k, strict=True))
        return float(sum((capacity * rises[name]).sum() for name, capacity in self._capacity_j_per_k.items()))

    @property
    def _min_time_constant_s(self) -> float:
        dark_w = np.zeros(len(self.pixels))
        times_s = [float((self.pixels.r_k_per_w * self.pixels.c_j_per_k).min()), float(self.pixels.tau_g_s.min())]
        # A step from nothing shows how quickly each state would be where it is driven to.
        for row in range(2, len(self.states)):
            state_k = self.cold_states()
            state_k[row] = 1.0
            rate = np.abs(self.rates(state_k, dark_w).state_per_s[row]).max()
            times_s.append(1.0 / float(rate))
        # Pixels that exchange heat are quickest against each other, which equal pixels do not show: power iteration.
        state_k = np.random.default_rng(0).choice([-1.0, 1.0], size=self.cold_states().shape)
        for _ in range(ITERATIONS):
            moving = self.rates(state_k, dark_w).state_per_s
            rate = np.abs(moving).max()
            state_k = moving / rate
        return min(*times_s, 1.0 / float(rate))

    def trace(self, drives: Sequence[Drive], t_s: FloatArray, steps: int = STEPS) -> ModelTrace:
        """From rest at 0: states and outputs at t_s [m], increasing; drives in order of their starts.

        Classical Runge–Kutta between the edges of the light, in steps of the quickest time constant over `steps`; one
        step is enough for what moves slowly in the dark.
        """
        edges_s = np.array([0.0, *(drive.start_s for drive in drives)])
        powers = [np.zeros(len(self.pixels)), *(drive.power_w for drive in drives)]
        step_s = self._min_time_constant_s / steps
        state_k, now_s, heat_j = self.cold_states(), 0.0, np.zeros(2)
        kept, heats, edge = [], [], 0
        for until_s in t_s.tolist():
            while now_s < until_s:
                while edge + 1 < len(edges_s) and edges_s[edge + 1] <= now_s:
                    edge += 1
                next_s = min(until_s, edges_s[edge + 1]) if edge + 1 < len(edges_s) else until_s
                state_k, more_j = self._advance(state_k, powers[edge], next_s - now_s, step_s)
                heat_j, now_s = heat_j + more_j, next_s
            kept.append(state_k)
            heats.append([*heat_j, self.stored_j(state_k)])
        return self._build_trace(t_s, np.array(kept), np.array(heats))

    def _advance(
        self, state_k: FloatArray, power_w: FloatArray, time_s: float, step_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """States after time_s at constant power, and the heat absorbed and left meanwhile, J [2]."""
        steps = ceil(time_s / step_s)
        h = time_s / steps
        heat_j = np.zeros(2)
        for _ in range(steps):
            a = self.rates(state_k, power_w)
            b = self.rates(state_k + 0.5 * h * a.state_per_s, power_w)
            c = self.rates(state_k + 0.5 * h * b.state_per_s, power_w)
            d = self.rates(state_k + h * c.state_per_s, power_w)
            sums = [u + 2 * v + 2 * w + x for u, v, w, x in zip(a, b, c, d, strict=True)]
            state_k = state_k + h / 6 * sums[0]
            heat_j += h / 6 * np.array([sums[1].sum(), sums[2].sum()])
        return state_k, heat_j

    def _build_trace(self, t_s: FloatArray, states_k: FloatArray, heats_j: FloatArray) -> ModelTrace:
        displacement_m, force_n = self.outputs(states_k.transpose(1, 0, 2))
        return ModelTrace(
            t_s=t_s,
            rise_k={name: states_k[:, row] for row, name in enumerate(self.states)},
            displacement_m=displacement_m,
            force_n=force_n,
            absorbed_j=heats_j[:, 0],
            left_j=heats_j[:, 1],
            stored_j=heats_j[:, 2],
        )
