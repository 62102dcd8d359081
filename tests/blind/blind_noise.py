"""Noise of the blind recordings, and the significance of an effect after refitting the nominal model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from blind_display import DISPLACEMENT, FORCE, TEMPERATURE, Physics, compute_nominal_rises, find_edges

BASE = ("R", "C", "tau_g", "kappa", "phi")


@dataclass(frozen=True)
class NoiseColour:
    """White noise plus relaxations ("ou": deviation, time) or a damped oscillation (deviation, Hz, ζ)."""

    white: float
    kind: str = ""
    parts: tuple[tuple[float, ...], ...] = ()

    def system(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return transition, process noise, stationary covariance and read-out of the coloured part on a grid."""
        a, spread, read = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2)
        if self.kind == "ou":
            for k, (deviation, time) in enumerate(self.parts):
                a[k, k], spread[k, k], read[k] = math.exp(-dt / time), deviation**2, 1.0
        elif self.kind == "oscillation":
            deviation, hz, zeta = self.parts[0]
            w = 2 * math.pi * hz
            damped, fade = w * math.sqrt(1.0 - zeta**2), math.exp(-zeta * w * dt)
            c, s = math.cos(damped * dt), math.sin(damped * dt) / damped
            a = fade * np.array([[c + zeta * w * s, s], [-w * w * s, c - zeta * w * s]])
            spread, read = np.diag([deviation**2, (deviation * w) ** 2]), np.array([1.0, 0.0])
        return a, spread - a @ spread @ a.T, spread, read

    def sample(self, rng: np.random.Generator, n: int, dt: float) -> np.ndarray:
        """Return one realisation of the noise."""
        a, jump, spread, read = self.system(dt)
        white = self.white * rng.standard_normal(n)
        normals = rng.standard_normal((n, 2))
        return white + (
            _simulate_state_space(a, _compute_square_root(jump), _compute_square_root(spread), read, normals)
            if self.kind
            else 0.0
        )

    def whiten(self, columns: np.ndarray, dt: float) -> np.ndarray:
        """Return columns whitened to unit variance."""
        return _compute_innovations(*self.system(dt), self.white**2, np.ascontiguousarray(columns))


def _compute_square_root(m: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(m)
    return vectors * np.sqrt(np.maximum(values, 0.0))


@njit(cache=True)
def _simulate_state_space(a, jump, spread, read, normals):
    n = len(normals)
    result = np.empty(n)
    x = np.dot(spread, normals[0])
    for i in range(n):
        if i:
            x = np.dot(a, x) + np.dot(jump, normals[i])
        result[i] = read[0] * x[0] + read[1] * x[1]
    return result


@njit(cache=True)
def _compute_innovations(a, jump, spread, read, variance, columns):
    """Return the normalised innovations of a Kalman filter with the same gains for all columns."""
    n, m = columns.shape
    result = np.empty((n, m))
    p = spread.copy()
    x = np.zeros((2, m))
    for i in range(n):
        h0 = p[0, 0] * read[0] + p[0, 1] * read[1]
        h1 = p[1, 0] * read[0] + p[1, 1] * read[1]
        s = read[0] * h0 + read[1] * h1 + variance
        scale = 1.0 / math.sqrt(s)
        k0, k1 = h0 / s, h1 / s
        for j in range(m):
            e = columns[i, j] - read[0] * x[0, j] - read[1] * x[1, j]
            result[i, j] = e * scale
            y0, y1 = x[0, j] + k0 * e, x[1, j] + k1 * e
            x[0, j] = a[0, 0] * y0 + a[0, 1] * y1
            x[1, j] = a[1, 0] * y0 + a[1, 1] * y1
        q = np.empty((2, 2))
        q[0, 0], q[0, 1] = p[0, 0] - k0 * h0, p[0, 1] - k0 * h1
        q[1, 0], q[1, 1] = p[1, 0] - k1 * h0, p[1, 1] - k1 * h1
        p = np.dot(np.dot(a, q), a.T) + jump
    return result


def draw_noise_colour(rng: np.random.Generator, white: float) -> NoiseColour:
    """Draw white noise with one coloured part."""
    kind = int(rng.integers(4))
    size = white * float(np.exp(rng.uniform(np.log(0.3), np.log(1.2))))
    if kind == 0:
        return NoiseColour(white, "ou", ((size, float(np.exp(rng.uniform(np.log(5e-4), np.log(0.02))))),))
    if kind == 1:
        return NoiseColour(
            white, "oscillation", ((size, float(rng.uniform(15.0, 150.0)), float(rng.uniform(0.15, 0.7))),)
        )
    if kind == 2:
        quick, slow = float(rng.uniform(5e-4, 5e-3)), float(rng.uniform(0.02, 0.2))
        return NoiseColour(white, "ou", ((0.8 * size, quick), (0.6 * size, slow)))
    return NoiseColour(white, "ou", ((size, float(np.exp(rng.uniform(np.log(0.01), np.log(0.1))))),))


@dataclass(frozen=True)
class RunVariation:
    """Standard deviations of quantities that vary between runs."""

    power: float
    timing_s: float
    baseline: dict[str, float]


@dataclass
class BenchRun:
    """One run in the projection: drive, sample times and measured pixel."""

    key: str
    pulses: np.ndarray
    times: dict[str, np.ndarray]
    pixel: int
    ambient_k: float


def simulate_nominal_signals(base: Physics, row: BenchRun, shift: float = 0.0) -> dict[str, np.ndarray]:
    """Return the nominal signals as rises, without ambient and without mirrors."""
    edges, powers = find_edges(row.pulses, row.pixel)
    result = {}
    for name, t in row.times.items():
        if name in (TEMPERATURE, DISPLACEMENT, FORCE):
            theta, gas = compute_nominal_rises(edges, powers, t - shift, base.R, base.C, base.tau_g)
            result[name] = {TEMPERATURE: theta, DISPLACEMENT: base.kappa * gas, FORCE: base.phi * gas}[name]
    return result


def _columns(base: Physics, row: BenchRun) -> dict[str, np.ndarray]:
    """Return sensitivities to the logarithms of the base parameters and of the power, and to a late start."""
    centre = simulate_nominal_signals(base, row)
    result = {name: np.zeros((len(y), 7)) for name, y in centre.items()}
    for k, name in enumerate(BASE[:3]):
        step = 1e-4
        up = simulate_nominal_signals(base.with_(**{name: getattr(base, name) * (1 + step)}), row)
        down = simulate_nominal_signals(base.with_(**{name: getattr(base, name) * (1 - step)}), row)
        for signal in centre:
            result[signal][:, k] = (up[signal] - down[signal]) / (2 * step)
    late, early = simulate_nominal_signals(base, row, 2e-6), simulate_nominal_signals(base, row, -2e-6)
    for signal, y in centre.items():
        result[signal][:, 3] = y if signal == DISPLACEMENT else 0.0
        result[signal][:, 4] = y if signal == FORCE else 0.0
        result[signal][:, 5] = y
        result[signal][:, 6] = (late[signal] - early[signal]) / 4e-6
    return result


class Bench:
    """Norm of a difference in σ after nuisance and base parameters are refitted."""

    def __init__(
        self, base: Physics, rows: list[BenchRun], colours: dict[str, NoiseColour], run_variation: RunVariation
    ):
        self.base, self.rows, self.colours, self.run_variation = base, rows, colours, run_variation
        self._start = self._sensitivities(base)

    def _sensitivities(self, base: Physics) -> dict[str, dict[str, np.ndarray]]:
        result: dict[str, dict[str, np.ndarray]] = {}
        for row in self.rows:
            if row.key not in result:
                result[row.key] = {
                    signal: self._whiten(signal, row, np.column_stack([columns, np.ones(len(columns))]))
                    for signal, columns in _columns(base, row).items()
                }
        return result

    def _whiten(self, signal: str, row: BenchRun, columns: np.ndarray) -> np.ndarray:
        t = row.times[signal]
        return self.colours[signal].whiten(columns, float(t[-1] - t[0]) / (len(t) - 1))

    def _reduce(self, differences, sensitivities, extras) -> tuple[float, np.ndarray]:
        """Return the residual χ² and the best steps of the five parameters and of the extra columns."""
        many = 5 + len(extras)
        total = np.zeros((1 + many, 1 + many))
        members_by_content: dict[tuple, list[int]] = {}
        for index, row in enumerate(self.rows):
            content = (row.key, id(differences[index]), *(id(e[index]) for e in extras))
            members_by_content.setdefault(content, []).append(index)
        for members in members_by_content.values():
            index, row = members[0], self.rows[members[0]]
            names = [name for name in row.times if name in self.colours]
            wide = 1 + many + 2 + len(names)
            blocks = []
            for k, name in enumerate(names):
                own = np.column_stack([differences[index][name], *(e[index][name] for e in extras)])
                block = np.zeros((len(own), wide))
                own = self._whiten(name, row, own)
                block[:, 0], block[:, 6 : 1 + many] = own[:, 0], own[:, 1:]
                if name in sensitivities[row.key]:
                    known = sensitivities[row.key][name]
                    block[:, 1:6], block[:, 1 + many : 3 + many] = known[:, :5], known[:, 5:7]
                    block[:, 3 + many + k] = known[:, 7]
                else:
                    block[:, 3 + many + k] = self._whiten(name, row, np.ones((len(own), 1)))[:, 0]
                blocks.append(block)
            spread = [
                self.run_variation.power,
                self.run_variation.timing_s,
                *(self.run_variation.baseline[n] for n in names),
            ]
            stack = np.vstack(blocks)
            normal = stack.T @ stack
            local = normal[1 + many :, 1 + many :] + np.diag(1.0 / np.square(spread))
            scale = 1.0 / np.sqrt(np.diag(local))
            cross = normal[1 + many :, : 1 + many] * scale[:, None]
            solved = np.linalg.solve(local * np.outer(scale, scale), cross)
            total += len(members) * (normal[: 1 + many, : 1 + many] - cross.T @ solved)
        inner = total[1:, 1:]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), 1e-300))
        steps = scale * np.linalg.lstsq(inner * np.outer(scale, scale), scale * total[1:, 0], rcond=1e-12)[0]
        return float(max(total[0, 0] - total[1:, 0] @ steps, 0.0)), steps

    def sigma(self, shown: list[dict[str, np.ndarray]], refits: int = 4, extras=()) -> float:
        """Return the norm of the signals beyond the nominal model. Rises and mirror errors are as in `differences`."""
        base, sensitivities = self.base, self._start
        chi2 = 0.0
        for nth in range(max(refits, 1)):
            if nth:
                sensitivities = self._sensitivities(base)
            chi2, steps = self._reduce(self.differences(base, shown), sensitivities, extras)
            moves = np.clip(steps[:5], -0.4, 0.4)
            base = base.with_(**{k: getattr(base, k) * math.exp(s) for k, s in zip(BASE, moves, strict=True)})
        return math.sqrt(chi2)

    def differences(self, base: Physics, shown: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
        """Return signals minus nominal per run. Temperatures are relative to ambient, mirrors to their commands."""
        known: dict[str, dict[str, np.ndarray]] = {}
        done: dict[tuple[str, int], dict[str, np.ndarray]] = {}
        result = []
        for row, values in zip(self.rows, shown, strict=True):
            content = (row.key, id(values))
            if row.key not in known:
                known[row.key] = simulate_nominal_signals(base, row)
            if content not in done:
                done[content] = {name: y - known[row.key].get(name, 0.0) for name, y in values.items()}
            result.append(done[content])
        return result


def subtract_signals(
    some: list[dict[str, np.ndarray]], others: list[dict[str, np.ndarray]]
) -> list[dict[str, np.ndarray]]:
    """Subtract signals run by run. Runs that are one object stay one."""
    done: dict[tuple[int, int], dict[str, np.ndarray]] = {}
    result = []
    for a, b in zip(some, others, strict=True):
        content = (id(a), id(b))
        if content not in done:
            done[content] = {name: a[name] - b[name] for name in a}
        result.append(done[content])
    return result
