"""Compiled simulation of a model with terms: free run, filter and linearisation along a record.

Theory of operation. Classical Runge–Kutta between samples, with inputs held or interpolated linearly, substeps of at
most h_max. At each sample the predicted outputs are written, then the states may be corrected by a gain times the
prediction error, for outputs that were measured. A term with memory has one inner state, which is carried over each
substep in closed form and follows the model's states in the vector x. Without gains this is a free run. With the gains
of an extended Kalman filter the states follow the data, although the model is wrong, so that a term that depends on
them can be recognised; the gains are computed once and then kept, and the prediction errors remain smooth functions of
all parameters.

`linearise` also returns, per sample, the derivatives of the next state and of the outputs by states, by an additional
rate in each equation, and by each parameter, from single perturbed steps (`linearisation.py`).
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

from optodrive.core.kernels import compile_here
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.discovery.forms import evaluate_form
from optodrive.lab.discovery.linearisation import copy, correct, predict_covariance
from optodrive.lab.discovery.memory import DELAY, NONE, OSCILLATION, carry, oscillate, start_memory, take_value

PLACE, FORM, VARIABLE, FACTOR, MEMORY = range(5)
"""Columns of a table of terms: place (states' equations, then outputs), form, variable, a variable that multiplies the
form, or -1, and which memory of the variable the form is a function of. Variables: states, inputs, time, quantities of
the model. The table of values holds amplitude, the form's inner numbers and the memory's scale; an oscillation's
damping takes the place of the second inner number, and its rate follows it in the vector of states."""
DAMPING, SCALE = 2, 3
STEP = 1e-5
"""Relative step of derivatives."""
MAX_STATE = 1e9
MAX_SUBSTEPS = 4096


_to_tuple: Any = to_fixed_tuple  # its type takes the compiler's context for an argument


class Kernels(NamedTuple):
    """Compiled functions of one model.

    run(fixed, x0, p, values, gains, workspace, predicted, states);
    linearise(fixed, x0, ps, values_s, deltas, scales, (q, r, p0), workspace, out);
    describe(times, states, inputs, p, out): the model's quantities at each of m samples;
    fixed: times, inputs, their slopes and outputs of a record, table of terms, longest step, and rule for inputs
    """

    run: Callable[..., None]
    linearise: Callable[..., None]
    describe: Callable[..., None]
    is_compiled: bool


@lru_cache(maxsize=64)
def build_kernels(
    rhs: Any, output: Any, quantity: Any, n: int, i: int, o: int, c: int, parameters: tuple[str, ...]
) -> Kernels:
    """Return the functions of a model, compiled if numba can, interpreted otherwise.

    Functions that return a display of numbers compile to code without reference counts, which is several times as fast.
    """
    p = np.ones(1, dtype=[(name, np.float64) for name in parameters])
    t, u, y = np.array([0.0, 1e-9]), np.zeros((2, i)), np.zeros((2, o))
    terms, values, gains = np.zeros((0, 5), dtype=np.int64), np.zeros((0, 4)), np.zeros((2, n, o))
    work = allocate_work(n, i, o, c)
    for count_references in (False, True):
        kernels = _build(rhs, output, quantity, n, i, o, count_references)
        try:
            kernels.run((t, u, u, y, terms, 1.0, 0), np.ones(n), p, values, gains, work, y.copy(), np.zeros((2, n)))
        except (NumbaError, TypeError, NotImplementedError):
            continue
        return kernels
    return _build(rhs, output, quantity, n, i, o, None)


def allocate_work(n: int, i: int, o: int, c: int) -> tuple[FloatArray, ...]:
    """Return work arrays of a run with n states, those of memories included: [10, n], [i], [o], [2, n, n] and [c]."""
    return np.zeros((10, n)), np.zeros(i), np.zeros(o), np.zeros((2, n, n)), np.zeros(c)


def _return_tuple(function: Any) -> Any:
    """Return the function with a list display after `return` made a tuple, which needs no allocation."""
    code = bytearray(function.__code__.co_code)
    for before, after in pairwise(dis.get_instructions(function)):
        if before.opname == "BUILD_LIST" and after.opname == "RETURN_VALUE":
            code[before.offset] = dis.opmap["BUILD_TUPLE"]
    changed = function.__code__.replace(co_code=bytes(code))
    return FunctionType(changed, function.__globals__, function.__name__, function.__defaults__, function.__closure__)


def _build(rhs: Any, output: Any, quantity: Any, n: int, i: int, o: int, counts_references: bool | None) -> Kernels:
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
        quantity = compile_(quantity if counts_references else _return_tuple(quantity))
    else:
        state_tuple, input_tuple = lambda x: np.array(x[:n]), np.array
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

    @compile_
    def variable(which: int, t: float, x: Any, u: Any, derived: Any) -> float:
        if which < n:
            return float(x[which])
        if which > n + i:
            return float(derived[which - n - i - 1])
        return float(u[which - n]) if which < n + i else t

    @compile_
    def delayed(which: int, k: int, t: float, z: float, delay: float, fixed: Any, states: Any) -> float:
        """Return a state or an input as it was before a delay, at time t after sample k, when it is z."""
        times, u, d, _, _, _, hold = fixed
        at, is_state = t - delay, which < n
        column = which if is_state else which - n
        past = states if is_state else u
        if at <= times[0]:
            return float(past[0, column])
        last = k
        while last > 0 and times[last] > at:
            last -= 1
        before, h = past[last, column], max((t if last == k else times[last + 1]) - times[last], 1e-300)
        after, part = z if last == k else past[last + 1, column], (at - times[last]) / h
        rise = after - before
        low = high = rise
        if is_state:  # its slopes from the samples beside
            if last > 0:
                low = h * (after - past[last - 1, column]) / (times[last] + h - times[last - 1])
            if last + 2 <= k:
                high = h * (past[last + 2, column] - before) / (times[last + 2] - times[last])
        elif hold > 1:
            low, high = h * d[last, column], h * d[min(last + 1, len(times) - 1), column]
        back = 1.0 - part
        return float(before + part * rise + part * back * (back * (low - rise) - part * (high - rise)))

    @compile_
    def read_variables(terms: Any, t: float, x: Any, u: Any, derived: Any, out: Any) -> None:
        """Write the variable of each term with memory."""
        slot = n
        for row in range(len(terms)):
            if terms[row, MEMORY] != NONE:
                out[slot] = variable(terms[row, VARIABLE], t, x, u, derived)
                slot += 2 if terms[row, MEMORY] == OSCILLATION else 1

    @compile_
    def remember(
        k: int,
        t: float,
        dt: float,
        x: Any,
        u: Any,
        values: Any,
        derived: Any,
        z0: Any,
        fixed: Any,
        states: Any,
        out: Any,
    ) -> None:
        """Write the memories at time t after sample k, dt after they were x and their variables z0. u: [i] inputs."""
        slot, terms = n, fixed[4]
        for row in range(len(terms)):
            kind = terms[row, MEMORY]
            if kind != NONE:
                z = variable(terms[row, VARIABLE], t, out, u, derived)
                if kind == DELAY:
                    out[slot] = delayed(terms[row, VARIABLE], k, t, z, values[row, SCALE], fixed, states)
                elif kind == OSCILLATION:
                    scale, damping = values[row, SCALE], values[row, DAMPING]
                    out[slot], out[slot + 1] = oscillate(x[slot], x[slot + 1], z0[slot], z, dt, scale, damping)
                    slot += 1
                else:
                    out[slot] = carry(kind, x[slot], z0[slot], z, dt, values[row, SCALE])
                slot += 1

    @compile_
    def add_terms(
        first: int, last: int, terms: Any, values: Any, t: float, x: Any, u: Any, derived: Any, out: Any
    ) -> None:
        """Add the terms at places from first to last, with the memories in x."""
        slot = n
        for row in range(len(terms)):
            z = variable(terms[row, VARIABLE], t, x, u, derived)
            if terms[row, MEMORY] != NONE:
                z = take_value(terms[row, MEMORY], x[slot], z)
                slot += 2 if terms[row, MEMORY] == OSCILLATION else 1
            if first <= terms[row, PLACE] < last:
                factor = 1.0 if terms[row, FACTOR] < 0 else variable(terms[row, FACTOR], t, x, u, derived)
                form = evaluate_form(terms[row, FORM], z, values[row, 1], values[row, 2])
                out[terms[row, PLACE] - first] += factor * values[row, 0] * form

    @compile_
    def rates(
        t: float, x: Any, u: Any, ps: Any, q: int, terms: Any, values: Any, offset: Any, derived: Any, out: Any
    ) -> None:
        store(rhs(t, state_tuple(x), input_tuple(u), record(ps, q)), out[:n])
        for j in range(n):
            out[j] += offset[j]
        if len(terms) > 0:
            add_terms(0, n, terms, values, t, x, u, derived, out)

    @compile_
    def derive(t: float, x: Any, u: Any, ps: Any, q: int, terms: Any, derived: Any) -> None:
        if len(terms) > 0:
            store(quantity(t, state_tuple(x), input_tuple(u), record(ps, q)), derived)

    @compile_
    def observe(t: float, x: Any, u: Any, ps: Any, q: int, terms: Any, values: Any, derived: Any, out: Any) -> None:
        store(output(state_tuple(x), input_tuple(u), record(ps, q)), out)
        if len(terms) > 0:
            derive(t, x, u, ps, q, terms, derived)
            add_terms(n, n + o, terms, values, t, x, u, derived, out)

    @compile_
    def begin(fixed: Any, x0: Any, ps: Any, workspace: Any) -> None:
        """Write the states and memories at the start of a record."""
        (work, _, _, _, derived), terms = workspace, fixed[4]
        x = work[5]
        for s in range(n):
            x[s] = x0[s]
        work[6, :] = 0.0
        derive(fixed[0][0], x, fixed[1][0], ps, 0, terms, derived)
        read_variables(terms, fixed[0][0], x, fixed[1][0], derived, x)
        slot = n
        for row in range(len(terms)):
            if terms[row, MEMORY] != NONE:
                x[slot] = start_memory(terms[row, MEMORY], x[slot])
                if terms[row, MEMORY] == OSCILLATION:
                    slot += 1
                    x[slot] = 0.0
                slot += 1

    @compile_
    def advance(k: int, fixed: Any, ps: Any, q: int, values: Any, x: Any, workspace: Any, states: Any) -> None:
        """Advance x in place from sample k - 1 to k.

        workspace: work [10, n], of which row 6 is added to the rates, inputs held within a step [i], and others;
        states: [m, n] at samples before k
        """
        t, u, d, _, terms, h_max, hold = fixed
        work, held, _, _, derived = workspace
        t0, t1, u0, u1, d0, d1 = t[k - 1], t[k], u[k - 1], u[k], d[k - 1], d[k]
        steps = min(max(1, ceil((t1 - t0) / h_max - 1e-6)), MAX_SUBSTEPS)
        h = (t1 - t0) / steps
        offset, z0, has_memory = work[6], work[9], len(x) > n
        for step in range(steps):
            at = step / steps
            for stage in range(4):
                part = at + (0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)) / steps
                for j in range(i):
                    held[j] = u0[j]
                    if hold > 0:
                        held[j] += part * (u1[j] - u0[j])
                    if hold > 1:
                        rise, back = u1[j] - u0[j], 1.0 - part
                        held[j] += part * back * (back * ((t1 - t0) * d0[j] - rise) - part * ((t1 - t0) * d1[j] - rise))
                weight = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
                for j in range(n):
                    work[4, j] = x[j] + (weight * work[stage - 1, j] if stage > 0 else 0.0)
                now = t0 + part * (t1 - t0)
                derive(now, work[4], held, ps, q, terms, derived)
                if has_memory:
                    if stage == 0:
                        if step == 0 and hold == 0 and k > 1:  # the input jumped at the sample
                            read_variables(terms, t0, work[4], u[k - 2], derived, z0)
                            remember(k - 1, t0, 0.0, x, held, values, derived, z0, fixed, states, work[4])
                            for j in range(n, len(x)):
                                x[j] = work[4, j]
                        read_variables(terms, now, work[4], held, derived, z0)
                    remember(k - 1, now, weight, x, held, values, derived, z0, fixed, states, work[4])
                rates(now, work[4], held, ps, q, terms, values, offset, derived, work[stage])
            for j in range(n):
                work[4, j] = x[j] + h / 6.0 * (work[0, j] + 2.0 * work[1, j] + 2.0 * work[2, j] + work[3, j])
            if has_memory:
                derive(now, work[4], held, ps, q, terms, derived)
                remember(k - 1, now, h, x, held, values, derived, z0, fixed, states, work[4])
            copy(work[4], x)

    @compile_
    def is_sound(x: Any) -> bool:
        sound = True
        for j in range(len(x)):
            sound = sound and isfinite(x[j]) and abs(x[j]) <= MAX_STATE
        return sound

    @compile_
    def run(fixed: Any, x0: Any, ps: Any, values: Any, gains: Any, workspace: Any, predicted: Any, states: Any) -> None:
        t, u, _, y, terms, _, _ = fixed
        work, _, _, _, derived = workspace
        x = work[5]
        begin(fixed, x0, ps, workspace)
        for k in range(len(t)):
            if k > 0:
                advance(k, fixed, ps, 0, values, x, workspace, states)
            if not is_sound(x):
                predicted[k:] = np.nan
                states[k:] = np.nan
                return
            observe(t[k], x, u[k], ps, 0, terms, values, derived, predicted[k])
            for j in range(o):
                if isfinite(y[k, j]):
                    for s in range(gains.shape[1]):  # a term's memory that was added later is not corrected
                        x[s] += gains[k, s, j] * (y[k, j] - predicted[k, j])
            copy(x, states[k])

    @compile_
    def linearise(
        fixed: Any, x0: Any, ps: Any, values: Any, deltas: Any, scales: Any, variances: Any, workspace: Any, out: Any
    ) -> None:
        predicted, variance, states, gains, transition, response, forcing, observation, direct = out
        t, u, _, y, terms, _, _ = fixed
        work, _, y1, half, derived = workspace
        noise_rate, noise, start_variance = variances
        x, offset, before, moved = work[5], work[6], work[7], work[8]
        size_n = len(x)
        begin(fixed, x0, ps, workspace)
        covariance = half[0]
        covariance[:] = 0.0
        for s in range(size_n):
            covariance[s, s] = start_variance[s]
        for k in range(len(t)):
            if k > 0:
                copy(x, before)
                # Unperturbed, then each state, each rate and each number moved a little.
                for case in range(1 + 2 * size_n + len(deltas)):
                    q, j, size = 0, (case - 1) % size_n, 1.0
                    if size_n < case <= 2 * size_n and j >= n:
                        continue
                    copy(before, moved)
                    if 1 <= case <= size_n:
                        size = STEP * scales[j]
                        moved[j] += size
                    elif size_n < case <= 2 * size_n:
                        size = STEP * scales[j] / (t[k] - t[k - 1])
                        offset[j] = size
                    elif case > 2 * size_n:
                        q = case - 2 * size_n
                        size = deltas[q - 1]
                    advance(k, fixed, ps, q, values[q], moved, workspace, states)
                    for s in range(size_n):
                        if case == 0:
                            x[s] = moved[s]
                        elif case <= size_n:
                            transition[k, s, j] = (moved[s] - x[s]) / size
                        elif case <= 2 * size_n:
                            response[k, s, j] = (moved[s] - x[s]) / size
                        else:
                            forcing[k, s, q - 1] = (moved[s] - x[s]) / size
                    offset[:] = 0.0
                predict_covariance(covariance, half[1], transition[k], noise_rate, t[k] - t[k - 1])
            if not is_sound(x):
                predicted[k:] = np.nan
                states[k:] = np.nan
                return
            for case in range(1 + size_n + len(deltas)):
                q, size = max(case - size_n, 0), 1.0
                copy(x, moved)
                if 1 <= case <= size_n:
                    size = STEP * scales[case - 1]
                    moved[case - 1] += size
                elif q > 0:
                    size = deltas[q - 1]
                observe(t[k], moved, u[k], ps, q, terms, values[q], derived, y1)
                for j in range(o):
                    if case == 0:
                        predicted[k, j] = y1[j]
                    elif case <= size_n:
                        observation[k, j, case - 1] = (y1[j] - predicted[k, j]) / size
                    else:
                        direct[k, j, q - 1] = (y1[j] - predicted[k, j]) / size
            correct(x, covariance, observation[k], noise, y[k], predicted[k], variance[k], gains[k])
            copy(x, states[k])

    @compile_
    def describe(t: Any, x: Any, u: Any, ps: Any, out: Any) -> None:
        for k in range(len(t)):
            store(quantity(t[k], state_tuple(x[k]), input_tuple(u[k]), record(ps, 0)), out[k])

    return Kernels(run, linearise, describe, is_compiled)
