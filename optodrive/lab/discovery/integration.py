"""Compiled simulation of a model with terms: free run, filter and linearisation along a record.

Theory of operation. Classical Runge–Kutta between samples, with inputs held or interpolated linearly, substeps of at
most h_max. At each sample the predicted outputs are written, then the states may be corrected by a gain times the
prediction error, for outputs that were measured. Without gains this is a free run. With the gains of an extended Kalman
filter the states follow the data, although the model is wrong, so that a term that depends on them can be recognised;
the gains are computed once and then kept, and the prediction errors remain smooth functions of all parameters.

`linearise` also returns, per sample, the derivatives of the next state and of the outputs by states, by an additional
rate in each equation, and by each parameter, from single perturbed steps. `propagate_term` and `propagate_parameters`
turn them into the change of all predictions by a term or a parameter: linear recursions, a thousand columns per second.
"""

import dis
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from math import ceil, isfinite
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from numba import literal_unroll
from numba.core.errors import NumbaError
from numba.np.unsafe.ndarray import to_fixed_tuple

from optodrive.core.kernels import array_kernel, compile_here, kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.discovery.forms import evaluate_form

PLACE, FORM, VARIABLE, FACTOR = range(4)
"""Columns of a table of terms: place (states' equations, then outputs), form, variable, and a variable that multiplies
the form, or -1. Variables: states, inputs, time. The table of values holds amplitude and the form's inner numbers."""
STEP = 1e-5
"""Relative step of derivatives."""
MAX_STATE = 1e9
MAX_SUBSTEPS = 4096


_to_tuple: Any = to_fixed_tuple  # its type takes the compiler's context for an argument


class Kernels(NamedTuple):
    """Compiled functions of one model.

    run(t, u, d, y, x0, p, terms, values, h_max, hold, gains, predicted, states);
    linearise(t, u, d, y, x0, ps, terms, values_s, deltas, scales, h_max, q, r, p0, out)
    """

    run: Callable[..., None]
    linearise: Callable[..., None]
    is_compiled: bool


class Linearisation(NamedTuple):
    """Derivatives along one record of m samples: n states, o outputs, q parameters.

    predicted, variance: [m, o] outputs and their expected variance; states: [m, n] corrected; gains: [m, n, o];
    transition: [m, n, n] from one corrected state to the next predicted one; response: [m, n, n] by a constant rate in
    each equation meanwhile; forcing: [m, n, q]; observation: [m, o, n]; direct: [m, o, q]
    """

    predicted: FloatArray
    variance: FloatArray
    states: FloatArray
    gains: FloatArray
    transition: FloatArray
    response: FloatArray
    forcing: FloatArray
    observation: FloatArray
    direct: FloatArray

    @classmethod
    def allocate(cls, m: int, n: int, o: int, q: int) -> "Linearisation":
        """Return arrays of zeros."""
        shapes = ((m, o), (m, o), (m, n), (m, n, o), (m, n, n), (m, n, n), (m, n, q), (m, o, n), (m, o, q))
        return cls(*(np.zeros(shape) for shape in shapes))


@lru_cache(maxsize=64)
def build_kernels(rhs: Any, output: Any, n: int, i: int, o: int, parameters: tuple[str, ...]) -> Kernels:
    """Return the functions of a model, compiled if numba can, interpreted otherwise.

    Functions that return a display of numbers compile to code without reference counts, which is several times as fast.
    """
    p = np.ones(1, dtype=[(name, np.float64) for name in parameters])
    t, u, y = np.array([0.0, 1e-9]), np.zeros((2, i)), np.zeros((2, o))
    terms, values, gains = np.zeros((0, 4), dtype=np.int64), np.zeros((0, 3)), np.zeros((2, n, o))
    work = allocate_work(n, i, o)
    for count_references in (False, True):
        kernels = _build(rhs, output, n, i, o, count_references)
        try:
            kernels.run(t, u, u, y, np.ones(n), p, terms, values, 1.0, 0, gains, work, y.copy(), np.zeros((2, n)))
        except (NumbaError, TypeError, NotImplementedError):
            continue
        return kernels
    return _build(rhs, output, n, i, o, None)


def allocate_work(n: int, i: int, o: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return work arrays of a run: [9, n], [i], [o] and [2, n, n]."""
    return np.zeros((9, n)), np.zeros(i), np.zeros(o), np.zeros((2, n, n))


def _return_tuple(function: Any) -> Any:
    """Return the function with a list display after `return` made a tuple, which needs no allocation."""
    code = bytearray(function.__code__.co_code)
    for before, after in pairwise(dis.get_instructions(function)):
        if before.opname == "BUILD_LIST" and after.opname == "RETURN_VALUE":
            code[before.offset] = dis.opmap["BUILD_TUPLE"]
    changed = function.__code__.replace(co_code=bytes(code))
    return FunctionType(changed, function.__globals__, function.__name__, function.__defaults__, function.__closure__)


def _build(rhs: Any, output: Any, n: int, i: int, o: int, counts_references: bool | None) -> Kernels:
    """Return compiled functions, with reference counts or without, or interpreted ones (None)."""
    is_compiled = counts_references is not None

    def compile_(function: Any) -> Any:
        return function if counts_references is None else compile_here(function, counts_references)

    if is_compiled:
        # User functions receive tuples: numba can unpack these.
        state_tuple = compile_(lambda x: _to_tuple(x, n))
        input_tuple = compile_(lambda u: _to_tuple(u, i)) if i else compile_(lambda u: ())
        record = compile_(lambda ps, q: ps[q])
        rhs = compile_(rhs if counts_references else _return_tuple(rhs))
        output = compile_(output if counts_references else _return_tuple(output))
    else:
        state_tuple = input_tuple = np.array
        record = lambda ps, q: ps.view(np.recarray)[q]  # noqa: E731
    if counts_references or not is_compiled:

        @compile_
        def store(result: Any, out: Any) -> None:
            for j in range(len(out)):
                out[j] = result[j]
    else:

        @compile_
        def store(result: Any, out: Any) -> None:
            j = 0
            for each in literal_unroll(result):  # numba unrolls no enumeration
                out[j] = each
                j += 1  # noqa: SIM113

    predict_covariance, correct, form = _predict_covariance, _correct, evaluate_form

    @compile_
    def variable(which: int, t: float, x: Any, u: Any) -> float:
        if which < n:
            return float(x[which])
        return float(u[which - n]) if which < n + i else t

    @compile_
    def term_value(terms: Any, values: Any, row: int, t: float, x: Any, u: Any) -> float:
        factor = 1.0 if terms[row, FACTOR] < 0 else variable(terms[row, FACTOR], t, x, u)
        z = variable(terms[row, VARIABLE], t, x, u)
        return float(factor * values[row, 0] * form(terms[row, FORM], z, values[row, 1], values[row, 2]))

    @compile_
    def rates(t: float, x: Any, u: Any, ps: Any, q: int, terms: Any, values: Any, offset: Any, out: Any) -> None:
        store(rhs(t, state_tuple(x), input_tuple(u), record(ps, q)), out)
        for j in range(n):
            out[j] += offset[j]
        for row in range(len(terms)):
            if terms[row, PLACE] < n:
                out[terms[row, PLACE]] += term_value(terms, values, row, t, x, u)

    @compile_
    def observe(t: float, x: Any, u: Any, ps: Any, q: int, terms: Any, values: Any, out: Any) -> None:
        store(output(state_tuple(x), input_tuple(u), record(ps, q)), out)
        for row in range(len(terms)):
            if terms[row, PLACE] >= n:
                out[terms[row, PLACE] - n] += term_value(terms, values, row, t, x, u)

    @compile_
    def advance(
        t0: float,
        t1: float,
        u0: Any,
        u1: Any,
        d0: Any,
        d1: Any,
        hold: int,
        ps: Any,
        q: int,
        terms: Any,
        values: Any,
        offset: Any,
        h_max: float,
        x: Any,
        work: Any,
        u: Any,
    ) -> None:
        """Advance x in place.

        work: [5, n]; u: [i]; d0, d1: slopes of the inputs; hold: 0, 1 or 2
        """
        steps = min(max(1, ceil((t1 - t0) / h_max - 1e-6)), MAX_SUBSTEPS)
        h = (t1 - t0) / steps
        for step in range(steps):
            at = step / steps
            for stage in range(4):
                part = at + (0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)) / steps
                for j in range(i):
                    u[j] = u0[j]
                    if hold > 0:
                        u[j] += part * (u1[j] - u0[j])
                    if hold > 1:
                        rise, back = u1[j] - u0[j], 1.0 - part
                        u[j] += part * back * (back * ((t1 - t0) * d0[j] - rise) - part * ((t1 - t0) * d1[j] - rise))
                weight = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
                for j in range(n):
                    work[4, j] = x[j] + (weight * work[stage - 1, j] if stage > 0 else 0.0)
                rates(t0 + part * (t1 - t0), work[4], u, ps, q, terms, values, offset, work[stage])
            for j in range(n):
                x[j] += h / 6.0 * (work[0, j] + 2.0 * work[1, j] + 2.0 * work[2, j] + work[3, j])

    @compile_
    def is_sound(x: Any) -> bool:
        sound = True
        for j in range(n):
            sound = sound and isfinite(x[j]) and abs(x[j]) <= MAX_STATE
        return sound

    @compile_
    def run(
        t: Any,
        u: Any,
        d: Any,
        y: Any,
        x0: Any,
        ps: Any,
        terms: Any,
        values: Any,
        h_max: float,
        hold: int,
        gains: Any,
        workspace: Any,
        predicted: Any,
        states: Any,
    ) -> None:
        work, held, _, _ = workspace
        x, offset = work[5], work[6]
        x[:] = x0
        offset[:] = 0.0
        for k in range(len(t)):
            if k > 0:
                advance(
                    t[k - 1],
                    t[k],
                    u[k - 1],
                    u[k],
                    d[k - 1],
                    d[k],
                    hold,
                    ps,
                    0,
                    terms,
                    values,
                    offset,
                    h_max,
                    x,
                    work,
                    held,
                )
            if not is_sound(x):
                predicted[k:] = np.nan
                states[k:] = np.nan
                return
            observe(t[k], x, u[k], ps, 0, terms, values, predicted[k])
            for j in range(o):
                if isfinite(y[k, j]):
                    for s in range(n):
                        x[s] += gains[k, s, j] * (y[k, j] - predicted[k, j])
            states[k] = x

    @compile_
    def linearise(
        t: Any,
        u: Any,
        d: Any,
        y: Any,
        x0: Any,
        ps: Any,
        terms: Any,
        values: Any,
        deltas: Any,
        scales: Any,
        h_max: float,
        hold: int,
        noise_rate: Any,
        noise: Any,
        start_variance: Any,
        workspace: Any,
        out: Any,
    ) -> None:
        predicted, variance, states, gains, transition, response, forcing, observation, direct = out
        work, held, y1, half = workspace
        x, offset, before, moved = work[5], work[6], work[7], work[8]
        x[:] = x0
        offset[:] = 0.0
        covariance = half[0]
        covariance[:] = 0.0
        for s in range(n):
            covariance[s, s] = start_variance[s]
        for k in range(len(t)):
            if k > 0:
                before[:] = x
                # Unperturbed, then each state, each rate and each number moved a little.
                for case in range(1 + 2 * n + len(deltas)):
                    q, j, size = 0, (case - 1) % n, 1.0
                    moved[:] = before
                    if 1 <= case <= n:
                        size = STEP * scales[j]
                        moved[j] += size
                    elif n < case <= 2 * n:
                        size = STEP * scales[j] / (t[k] - t[k - 1])
                        offset[j] = size
                    elif case > 2 * n:
                        q = case - 2 * n
                        size = deltas[q - 1]
                    advance(
                        t[k - 1],
                        t[k],
                        u[k - 1],
                        u[k],
                        d[k - 1],
                        d[k],
                        hold,
                        ps,
                        q,
                        terms,
                        values[q],
                        offset,
                        h_max,
                        moved,
                        work,
                        held,
                    )
                    for s in range(n):
                        if case == 0:
                            x[s] = moved[s]
                        elif case <= n:
                            transition[k, s, j] = (moved[s] - x[s]) / size
                        elif case <= 2 * n:
                            response[k, s, j] = (moved[s] - x[s]) / size
                        else:
                            forcing[k, s, q - 1] = (moved[s] - x[s]) / size
                    offset[:] = 0.0
                predict_covariance(covariance, half[1], transition[k], noise_rate, t[k] - t[k - 1])
            if not is_sound(x):
                predicted[k:] = np.nan
                states[k:] = np.nan
                return
            for case in range(1 + n + len(deltas)):
                q, size = max(case - n, 0), 1.0
                moved[:] = x
                if 1 <= case <= n:
                    size = STEP * scales[case - 1]
                    moved[case - 1] += size
                elif q > 0:
                    size = deltas[q - 1]
                observe(t[k], moved, u[k], ps, q, terms, values[q], y1)
                for j in range(o):
                    if case == 0:
                        predicted[k, j] = y1[j]
                    elif case <= n:
                        observation[k, j, case - 1] = (y1[j] - predicted[k, j]) / size
                    else:
                        direct[k, j, q - 1] = (y1[j] - predicted[k, j]) / size
            correct(x, covariance, observation[k], noise, y[k], predicted[k], variance[k], gains[k])
            states[k] = x

    return Kernels(run, linearise, is_compiled)


@kernel
def _correct(
    x: FloatArray,
    covariance: FloatArray,
    observation: FloatArray,
    noise: FloatArray,
    y: FloatArray,
    predicted: FloatArray,
    variance: FloatArray,
    gains: FloatArray,
) -> None:
    """Correct states and covariance by each output that was measured, and write their joint gains."""
    n, o = len(x), len(y)
    for j in range(o):
        s = noise[j]
        for a in range(n):
            for b in range(n):
                s += observation[j, a] * covariance[a, b] * observation[j, b]
        variance[j] = s
        if not (isfinite(y[j]) and isfinite(s) and s > 0.0):
            continue
        for a in range(n):
            total = 0.0
            for b in range(n):
                total += covariance[a, b] * observation[j, b]
            gains[a, j] = total / s
        # The gains of earlier outputs of this sample already move this output.
        for other in range(j):
            moves = 0.0
            for a in range(n):
                moves += observation[j, a] * gains[a, other]
            for a in range(n):
                gains[a, other] -= gains[a, j] * moves
        for a in range(n):
            for b in range(n):
                covariance[a, b] -= gains[a, j] * s * gains[b, j]
    for j in range(o):
        if isfinite(y[j]):
            for a in range(n):
                x[a] += gains[a, j] * (y[j] - predicted[j])


@kernel
def _predict_covariance(
    covariance: FloatArray, half: FloatArray, transition: FloatArray, noise_rate: FloatArray, dt_s: float
) -> None:
    """Carry the covariance to the next sample, in place."""
    n = len(covariance)
    for a in range(n):
        for b in range(n):
            half[a, b] = 0.0
            for c in range(n):
                half[a, b] += transition[a, c] * covariance[c, b]
    for a in range(n):
        for b in range(n):
            total = noise_rate[a] * dt_s if a == b else 0.0
            for c in range(n):
                total += half[a, c] * transition[b, c]
            covariance[a, b] = total


@array_kernel
def propagate_term(
    transition: FloatArray,
    drive: FloatArray,
    observation: FloatArray,
    direct: FloatArray,
    gains: FloatArray,
    term: FloatArray,
) -> FloatArray:
    """Return the change of the predictions [m, o, c] by terms [m, c] that enter by drive [m, n] and direct [o]."""
    m, n = drive.shape
    o, c = len(direct), term.shape[1]
    out, delta, moved = np.zeros((m, o, c)), np.zeros((n, c)), np.zeros((n, c))
    for k in range(m):
        if k > 0:
            for s in range(n):
                for col in range(c):
                    total = drive[k, s] * 0.5 * (term[k - 1, col] + term[k, col])
                    for j in range(n):
                        total += transition[k, s, j] * delta[j, col]
                    moved[s, col] = total
            delta[:] = moved
        for j in range(o):
            for col in range(c):
                total = direct[j] * term[k, col]
                for s in range(n):
                    total += observation[k, j, s] * delta[s, col]
                out[k, j, col] = total
        for s in range(n):
            for j in range(o):
                for col in range(c):
                    delta[s, col] -= gains[k, s, j] * out[k, j, col]
    return out


@array_kernel
def propagate_parameters(
    transition: FloatArray,
    forcing: FloatArray,
    observation: FloatArray,
    direct: FloatArray,
    gains: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Return the derivatives of the predictions [m, o, q] by parameters, from those of the first state [n, q]."""
    m, n, count = forcing.shape
    o = direct.shape[1]
    out, delta, moved = np.zeros((m, o, count)), start.copy(), np.zeros((n, count))
    for k in range(m):
        if k > 0:
            for s in range(n):
                for q in range(count):
                    total = forcing[k, s, q]
                    for j in range(n):
                        total += transition[k, s, j] * delta[j, q]
                    moved[s, q] = total
            delta[:] = moved
        for j in range(o):
            for q in range(count):
                total = direct[k, j, q]
                for s in range(n):
                    total += observation[k, j, s] * delta[s, q]
                out[k, j, q] = total
        for s in range(n):
            for j in range(o):
                for q in range(count):
                    delta[s, q] -= gains[k, s, j] * out[k, j, q]
    return out
