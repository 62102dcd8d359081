"""Comparison of all places, variables, curves and formulas of a term by linear regression.

Theory of operation. Along the states of the filter, a term g(z) at one place changes the predictions, to first order,
by a linear functional of g. With g as a sum of hat functions of z, one linear recursion per hat gives a regression of
the prediction errors on the hats' weights. The columns of all fitted parameters stand beside them, so a term only
counts for what no parameter can do (orthogonality). The normal equations of each fold of samples suffice: curves with
a roughness penalty that is chosen by cross-validation over folds, their band, and any formula, whose column is the
hats' columns times its values at the nodes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import ceil

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.discovery.fitting import Point, Simulation, Terms, weigh
from optodrive.lab.discovery.forms import CONSTANT, CURVE, LINEAR, Form, list_forms
from optodrive.lab.discovery.linearisation import Linearisation
from optodrive.lab.discovery.memory import (
    DELAY,
    LAG,
    MAX_DAMPING,
    MIN_DAMPING,
    NONE,
    OSCILLATION,
    PATH,
    START_DAMPING,
    remember,
)
from optodrive.lab.discovery.model import Curve, Record

EVEN_NODES = 21
SHARES = np.array([0.003, 0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.3, 0.4])
"""Nodes at equal distances, and at these shares of the samples from either end: end stops act on few samples."""
PENALTIES = np.geomspace(1e-7, 1e3, 11)
RIDGE = 1e-9
PARAMETER_SHARE = 1e-4
"""Share of a column's sum of squares that no parameter explains, below which the column is one of the parameters'."""
OWN_SHARE = 1e-3
"""The same share, below which the curve is not drawn as the term's."""
BAND = 1.96
TWIN_SHARE = 0.02
"""Share of a term's squares that is no function of another variable, below which the data cannot tell them apart."""
SLOW_NODES = 6
Evaluate = Callable[[FloatArray], FloatArray]
MEMORY_NODES = 5
MIN_WAY, MAX_WAY, MAX_TIME, SCALE_RATIO, PERIOD_RATIO = 0.003, 0.5, 0.2, 2.5, 1.2
"""Distances of presliding relative to a variable's range, longest time constant relative to a record, and the ratio
from one scale of a memory, and of an oscillation, to the next."""


@dataclass(frozen=True, eq=False)
class Filtered:
    """Linearisation of one record with the derivatives [m, o, q] by all fitted numbers and the fold of each sample [m].

    fold: −1 where a sample is held out; variables, arriving: as of `Simulation.list_variables`
    """

    record: Record
    line: Linearisation
    columns: FloatArray
    fold: IntArray
    weights: FloatArray
    variables: FloatArray
    arriving: FloatArray

    def read(self, at: "Place") -> tuple[FloatArray, FloatArray]:
        """Return the arguments of a term at a place, [m] at the samples and [m] on arrival there."""
        leaving, arriving = self.variables[:, at.variable], self.arriving[:, at.variable]
        if at.memory == NONE:
            return leaving, arriving
        past = remember(at.memory, at.scale, self.record.t_s, arriving)
        return past, past


@dataclass(frozen=True)
class Place:
    """Place of a term, its variable, the variable that multiplies it (-1: none), and memory, as in `integration`."""

    place: int
    variable: int
    factor: int
    memory: int = NONE
    scale: float = 0.0
    shortest: float = 0.0

    @property
    def key(self) -> tuple[int, ...]:
        """The place without the scale, which is fitted."""
        return self.place, self.variable, self.factor, self.memory


@dataclass(frozen=True, eq=False)
class Screened:
    """A place with its normal equations in the hats' weights, less the part that parameters explain.

    nodes: [c]; matrix: [c, c]; full: [c, c] before that projection; vector: [c], over all fitted samples; loss:
    cross-validated, relative to that without a term; weights: [c] of the smooth curve; sigma: [c] their standard errors
    """

    at: Place
    nodes: FloatArray
    matrix: FloatArray
    full: FloatArray
    vector: FloatArray
    total: float
    loss: float
    weights: FloatArray
    sigma: FloatArray

    def add_curve(self, values: FloatArray) -> "Screened":
        """Return the normal equations of the whole term, where these are those beside a curve with values [c]."""
        change = self.matrix @ values
        total = self.total + float(2.0 * values @ self.vector + values @ change)
        return replace(self, vector=self.vector + change, total=total)

    def _interpolate(self, z: FloatArray) -> FloatArray:
        return np.asarray(np.interp(z, self.nodes, self.weights))

    @property
    def curve(self) -> Curve:
        """The smooth curve with its band."""
        half = BAND * self.sigma
        return Curve(self.nodes, self.weights, self.weights - half, self.weights + half, self._interpolate)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A form at a place, with its inner numbers and its amplitude."""

    screened: Screened
    form: Form
    first: float
    second: float
    amplitude: float

    @property
    def numbers(self) -> int:
        """How many numbers the formula has, and one for a factor."""
        memory = self.screened.at.memory
        return 1 + self.form.free + (self.screened.at.factor >= 0) + (memory != NONE) + (memory == OSCILLATION)

    @property
    def is_constant(self) -> bool:
        """Whether the term depends on nothing."""
        return self.form.kind == CONSTANT and self.screened.at.factor < 0

    def build_terms(self) -> Terms:
        """Return the candidate as a row of a table of terms, with limits of its numbers."""
        at, form, nodes = self.screened.at, self.form, self.screened.nodes
        span, (low, high) = float(nodes[-1] - nodes[0]), form.limit(nodes, self.first)
        second = (self.second, 0.01 * span, 10.0 * span)
        if at.memory == OSCILLATION:
            second = (START_DAMPING, MIN_DAMPING, MAX_DAMPING)
        return Terms(
            np.array([[at.place, form.code, at.variable, at.factor, at.memory]]),
            np.array([[self.amplitude, self.first, second[0], at.scale]]),
            np.array([[True, form.free > 0, form.free > 1 or at.memory == OSCILLATION, at.memory != NONE]]),
            np.array([[-np.inf, low, second[1], at.shortest]]),
            np.array([[np.inf, high, second[2], 20.0 * at.scale + 1e-300]]),
        )


def list_places(simulation: Simulation, filtered: Sequence[Filtered], point: Point) -> list[Place]:
    """Return all places with the variables and factors to be tried.

    Without places of the model's own, an equation that no parameter changes defines its state, as dx/dt = v does, and
    is left out unless all do.
    """
    model = simulation.model
    if model.places:
        names = model.variable_names
        return [
            Place(model.place_names.index(where), names.index(on), names.index(factor) if factor else -1)
            for where, on, factor in model.places
        ]
    n, i, o = len(model.states), len(model.inputs), len(model.outputs)
    equations = simulation.find_parametrised(filtered[0].record, filtered[0].line.states, point) or list(range(n))
    quantities = list(range(n + i))
    places = []
    for place in [*equations, *range(n, n + o)]:
        factors = [-1, *quantities] if place < n else [-1]
        for variable, factor in product([*quantities, n + i], factors):
            if factor != variable:
                places.append(Place(place, variable, factor))
    return places


def list_memories(simulation: Simulation, filtered: Sequence[Filtered], places: Sequence[Place]) -> list[Place]:
    """Return the places with a memory of each state and input, of some time constants and distances.

    A model that names its places names its memories too.
    """
    model = simulation.model
    times = [each.record.t_s for each in filtered]
    step_s, long_s = float(np.median(np.diff(times[0]))), max(float(t[-1] - t[0]) for t in times)
    spots, kinds = list(dict.fromkeys(at.place for at in places)), range(LAG, DELAY + 1)
    names = [
        (model.place_names.index(where), model.variable_names.index(on), kind)
        for where, on, own in model.memories
        for kind in own
    ]
    if not model.places:
        names = [*product(spots, range(len(model.states) + len(model.inputs)), kinds)]
    found = []
    for spot, variable, kind in names:
        span = float(np.ptp(np.concatenate([each.variables[:, variable] for each in filtered])))
        if not np.isfinite(span) or span <= 0.0:
            continue
        low, high, ratio = 2.0 * step_s, MAX_TIME * long_s, SCALE_RATIO
        if kind in PATH:
            low, high = MIN_WAY * span, MAX_WAY * span
        elif kind == OSCILLATION:  # whose phase a wrong period loses soon
            low, high, ratio = 0.25 * step_s, 10.0 * step_s, PERIOD_RATIO
        count = 1 + ceil(np.log(high / low) / np.log(ratio))
        # Over a shorter distance presliding is dry friction, which is a function of the present.
        shortest = low if kind in PATH else 0.25 * low
        found += [Place(spot, variable, -1, kind, float(scale), shortest) for scale in np.geomspace(low, high, count)]
    return found


def screen_memories(filtered: Sequence[Filtered], places: Sequence[Place], n: int) -> list[Place]:
    """Return the places with memory in order of evidence, each with its best scale, none that a parameter imitates."""
    q, best = filtered[0].columns.shape[2], dict[tuple[int, ...], tuple[float, Place]]()
    for spot in dict.fromkeys(at.place for at in places):
        own = [at for at in places if at.place == spot]

        def read(each: Filtered, own: Sequence[Place] = own) -> tuple[FloatArray, FloatArray]:
            past = np.column_stack([each.read(at)[0] for at in own])
            return past, past

        grams = _build_grams(filtered, spot, len(own), read, n)
        total = grams.sum(axis=0)
        for number, at in enumerate(own):
            rows = [*range(q), q + number, -1]
            small = [gram[np.ix_(rows, rows)] for gram in grams]
            matrix, _, _ = _project(total[np.ix_(rows, rows)], q)
            if not matrix[0, 0] > PARAMETER_SHARE * total[q + number, q + number]:
                continue
            loss = sum(_held_loss(sum(small) - fold, fold, q, 1, None) for fold in small)
            if np.isfinite(loss) and (at.key not in best or loss < best[at.key][0]):
                best[at.key] = loss, at
    return [at for _, at in sorted(best.values(), key=lambda item: item[0])]


def choose_nodes(values: FloatArray) -> FloatArray:
    """Return nodes [c] for a variable: over its range, and denser where its values are."""
    low, high = float(values.min()), float(values.max())
    shares = np.quantile(values, [*SHARES, 0.5, *(1.0 - SHARES)])
    nodes = np.unique(np.concatenate([np.linspace(low, high, EVEN_NODES), shares]))
    apart = 4e-3 * (high - low)
    kept = [nodes[0]]
    for node in nodes[1:-1]:
        if node - kept[-1] > apart and high - node > apart:
            kept.append(node)
    return np.array([*kept, high])


def hat_functions(z: FloatArray, nodes: FloatArray) -> FloatArray:
    """Return the hat functions [m, c] of the nodes at z [m]."""
    right = np.clip(np.searchsorted(nodes, z), 1, len(nodes) - 1)
    share = np.clip((z - nodes[right - 1]) / (nodes[right] - nodes[right - 1]), 0.0, 1.0)
    hats = np.zeros((len(z), len(nodes)))
    rows = np.arange(len(z))
    hats[rows, right - 1], hats[rows, right] = 1.0 - share, share
    return hats


def screen(filtered: Sequence[Filtered], at: Place, n: int) -> Screened | None:
    """Return the regression of a place on the fitted samples, None if the variable does not vary."""
    values = np.concatenate([each.read(at)[0] for each in filtered])
    if not np.isfinite(values).all() or np.ptp(values) <= 1e-9 * np.abs(values).max():
        return None
    nodes = choose_nodes(values) if at.memory == NONE else np.linspace(values.min(), values.max(), MEMORY_NODES)

    def read(each: Filtered) -> tuple[FloatArray, FloatArray]:
        leaving, arriving = (hat_functions(z, nodes) for z in each.read(at))
        if at.factor >= 0:
            return leaving * each.variables[:, at.factor, None], arriving * each.arriving[:, at.factor, None]
        return leaving, arriving

    grams = _build_grams(filtered, at.place, len(nodes), read, n)
    if not np.isfinite(grams).all():
        return None
    q = filtered[0].columns.shape[2]
    total = grams.sum(axis=0)
    without = float(np.sum([_held_loss(total - fold, fold, q, 0, None) for fold in grams]))
    roughness = _roughness(nodes)
    trace = np.trace(total[q:-1, q:-1]) / np.trace(roughness)
    c = len(nodes)
    losses = [
        float(np.sum([_held_loss(total - fold, fold, q, c, penalty * trace * roughness) for fold in grams]))
        for penalty in PENALTIES
    ]
    best = int(np.argmin(losses))
    matrix, vector, rest = _project(total, q)
    # What parameters can do nearly as well is not determined, and is drawn as zero.
    own = RIDGE * np.trace(matrix) * np.eye(c) + OWN_SHARE * total[q:-1, q:-1]
    regular = np.linalg.inv(matrix + PENALTIES[best] * trace * roughness + own)
    weights = regular @ vector
    samples = sum(int((each.weights > 0.0).sum()) for each in filtered)
    variance = np.maximum(rest - 2.0 * weights @ vector + weights @ matrix @ weights, 0.0) / float(max(samples, 1))
    sigma = np.sqrt(np.maximum(np.diag(regular), 0.0) * variance)
    return Screened(
        at, nodes, matrix, total[q:-1, q:-1], vector, rest, losses[best] / max(without, 1e-300), weights, sigma
    )


def _build_grams(
    filtered: Sequence[Filtered],
    place: int,
    count: int,
    read: Callable[[Filtered], tuple[FloatArray, FloatArray]],
    n: int,
) -> FloatArray:
    """Return the products of all columns, parameters, terms and prediction errors, of each fold [f, k, k].

    read: returns the terms at one place [m, count] at the samples, and as they are on arrival there
    """
    o = filtered[0].line.predicted.shape[1]
    direct = np.zeros(o)
    if place >= n:
        direct[place - n] = 1.0
    size = filtered[0].columns.shape[2] + count + 1
    grams = np.zeros((1 + max(int(each.fold.max()) for each in filtered), size, size))
    for each in filtered:
        if each.fold.max() < 0:
            continue
        leaving, arriving = read(each)
        line = each.line
        forcing = np.zeros((*line.states.shape, count))
        if place < n:
            forcing[1:] = (0.5 * line.response[1:, :, place])[:, :, None] * (leaving[:-1] + arriving[1:])[:, None, :]
        change = line.propagate(forcing, direct[:, None] * leaving[:, None, :], np.zeros((line.states.shape[1], count)))
        error = np.nan_to_num(each.record.outputs - line.predicted)[:, :, None]
        joined = weigh(each.record, np.concatenate([each.columns, change, error], axis=2), each.weights)
        for fold in np.unique(each.fold[each.fold >= 0]):
            part = joined[each.fold == fold].reshape(-1, size)
            grams[fold] += part.T @ part
    return grams


def _roughness(nodes: FloatArray) -> FloatArray:
    """Return the quadratic form of the squared second derivative of the curve through the nodes [c, c]."""
    h = np.diff((nodes - nodes[0]) / (nodes[-1] - nodes[0]))
    c = len(nodes)
    second = np.zeros((c - 2, c))
    for k in range(c - 2):
        second[k, k : k + 3] = np.array([1.0 / h[k], -1.0 / h[k] - 1.0 / h[k + 1], 1.0 / h[k + 1]])
        second[k] /= np.sqrt(0.5 * (h[k] + h[k + 1]))
    form: FloatArray = second.T @ second
    return form


def _solve(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / scale[:, None] / scale[None, :]
    solution: FloatArray = np.linalg.solve(scaled + RIDGE * np.eye(len(scaled)), vector / scale) / scale
    return solution


def _held_loss(fitted: FloatArray, held: FloatArray, q: int, c: int, penalty: FloatArray | None) -> float:
    """Return the squared error in a held fold of the regression on the others, on q parameters and c hats.

    It is not finite where it cannot be computed.
    """
    keep = np.arange(q + c)
    matrix = fitted[np.ix_(keep, keep)].copy()
    if penalty is not None:
        matrix[q:, q:] += penalty
    w = _solve(matrix, fitted[keep, -1])
    # Of a parameter that the other folds do not show, rounding leaves any weight: the loss may be infinite.
    with np.errstate(over="ignore", invalid="ignore"):
        return float(held[-1, -1] - 2.0 * w @ held[keep, -1] + w @ held[np.ix_(keep, keep)] @ w)


def _project(total: FloatArray, q: int) -> tuple[FloatArray, FloatArray, float]:
    """Return matrix, vector and sum of squares in the hats' weights, without the parameters' part."""
    head, cross = total[:q, :q], total[:q, q:]
    inner = np.column_stack([_solve(head, column) for column in cross.T]) if q else cross
    rest = total[q:, q:] - cross.T @ inner
    rest = 0.5 * (rest + rest.T)
    return rest[:-1, :-1], rest[:-1, -1], float(rest[-1, -1])


def follow(filtered: Sequence[Filtered], at: Place, evaluate: Evaluate) -> FloatArray:
    """Return the values of a term along the fitted samples of all records."""
    values = []
    for each in filtered:
        own = evaluate(each.read(at)[0]) * (each.variables[:, at.factor] if at.factor >= 0 else 1.0)
        values.append(own[each.fold >= 0])
    return np.concatenate(values)


def find_twin(filtered: Sequence[Filtered], at: Place, evaluate: Evaluate, names: Sequence[str], time: int) -> str:
    """Return a variable of which the term is a function too along these records, "" if there is none.

    names: of the variables; time: number of that which is time, of which only slow changes count
    """
    table = np.concatenate([each.variables[each.fold >= 0] for each in filtered])
    values = follow(filtered, at, evaluate)
    spread = float(np.sum((values - values.mean()) ** 2))
    for number, name in enumerate(names):
        variable = table[:, number]
        if (number == at.variable and at.factor < 0 and at.memory == NONE) or np.ptp(variable) <= 1e-9 * np.abs(
            variable
        ).max():
            continue
        nodes = np.linspace(variable.min(), variable.max(), SLOW_NODES) if number == time else choose_nodes(variable)
        hats = hat_functions(variable, nodes)
        rest = values - hats @ np.linalg.lstsq(hats.T @ hats, hats.T @ values, rcond=None)[0]
        if float(rest @ rest) < TWIN_SHARE * spread:
            return f"a function of {name}"
    return ""


def rank_formulas(found: Screened, count: int) -> list[Candidate]:
    """Return the best formulas of a place and one curve, none of which a parameter can imitate."""
    columns, owners = [], []
    for form in list_forms(found.nodes) if found.at.memory == NONE else [LINEAR]:
        for first, second in form.starts:
            values = form.evaluate(found.nodes, float(first), float(second))
            if not np.isfinite(values).all() or np.abs(values).max() == 0.0:
                continue
            columns.append(values / np.abs(values).max())
            owners.append((form, float(first), float(second), float(np.abs(values).max())))
    g = np.array(columns)
    squares = np.einsum("kc,cd,kd->k", g, found.matrix, g)
    usable = squares > PARAMETER_SHARE * np.maximum(np.einsum("kc,cd,kd->k", g, found.full, g), 1e-300)
    vector = g @ found.vector
    share = np.where(usable, vector**2 / np.maximum(squares, 1e-300), 0.0) / max(found.total, 1e-300)
    best: dict[tuple[str, str], int] = {}
    for k in np.argsort(-share):
        best.setdefault((owners[k][0].kind, owners[k][0].text), int(k))
    usable_best = [k for k in best.values() if usable[k]]
    physical = [k for k in usable_best if owners[k][0].kind != CURVE]
    # What all forms of a variable become beyond the data is compared with them in any case.
    constants = [k for k in physical[count:] if owners[k][0].kind == CONSTANT and found.at.factor < 0]
    curves = [k for k in usable_best if owners[k][0].kind == CURVE]
    return [
        Candidate(found, *owners[k][:3], float(vector[k] / squares[k] / owners[k][3]))
        for k in physical[:count] + constants + curves[:1]
    ]
