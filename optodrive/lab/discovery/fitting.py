"""A model with terms on prepared records: free run, filter, and fit of all free numbers by their prediction errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.lab.discovery.forms import THRESHOLDS
from optodrive.lab.discovery.integration import FORM, MEMORY, STEP, VARIABLE, Kernels, allocate_work, build_kernels
from optodrive.lab.discovery.linearisation import Linearisation
from optodrive.lab.discovery.memory import NONE, OSCILLATION, PATH
from optodrive.lab.discovery.model import OdeModel, Record
from optodrive.lab.inference.fit import fit_residuals

Gains = Sequence[FloatArray] | None
"""Gains [m, n, o] by which a filter corrects the states, per record; None for free runs."""
DIVERGED = 1e3
"""Residual in standard deviations of an output that stands for a diverged one."""
TOLERANCE = 1e-7
"""Relative change of squares and point at which a fit ends."""
CONVERGED = 1e-3
"""Change of a free run, relative to the outputs, at which the integration step is short enough."""
LONGEST_FROM_REST = 8.0
"""First step tried between samples that are dense where light changes, in their median distance."""


@dataclass(frozen=True, eq=False)
class Terms:
    """Terms added to a model, [r, 5] as in `integration`, with their numbers [r, 4] and which of them are fitted."""

    table: IntArray
    values: FloatArray
    free: BoolArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def none(cls) -> "Terms":
        """Return an empty table."""
        empty = np.zeros((0, 4))
        return cls(np.zeros((0, 5), dtype=np.int64), empty, np.zeros((0, 4), dtype=bool), empty, empty)

    def extend(self, other: "Terms") -> "Terms":
        """Return both."""
        return Terms(*(np.concatenate([getattr(self, f), getattr(other, f)]) for f in Terms.__dataclass_fields__))

    def freeze(self) -> "Terms":
        """Return the same terms, none of whose numbers is fitted."""
        return replace(self, free=np.zeros_like(self.free))

    def weaken(self, share: float) -> "Terms":
        """Return the same terms with this share of their amplitudes."""
        return replace(self, values=self.values * [share, 1.0, 1.0, 1.0])

    def free_thresholds(self, beyond: float) -> "Terms":
        """Return the same terms with limits of thresholds that lie further apart, by this share on either side."""
        rows, further = np.isin(self.table[:, FORM], THRESHOLDS), np.zeros_like(self.low)
        further[rows, 1] = beyond * (self.high - self.low)[rows, 1]
        return replace(self, low=self.low - further, high=self.high + further)

    @property
    def memories(self) -> IntArray:
        """Row of each inner state [k] that follows the model's."""
        kinds = self.table[:, MEMORY]
        return np.repeat(np.arange(len(kinds)), 1 * (kinds != NONE) + (kinds == OSCILLATION))

    def __getitem__(self, rows: slice) -> "Terms":
        return Terms(*(getattr(self, f)[rows] for f in Terms.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.table)


@dataclass(frozen=True, eq=False)
class Point:
    """Numbers of a model: parameters [q] in the model's order, and terms."""

    parameters: FloatArray
    terms: Terms

    def with_terms(self, terms: Terms) -> "Point":
        """Return the same parameters with other terms."""
        return replace(self, terms=terms)


class Simulation:
    """A model with an integration step and a rule for inputs between samples."""

    def __init__(self, model: OdeModel, h_max: float = np.inf, hold: int = 1) -> None:
        self.model = model
        self.h_max = h_max
        self.hold = hold
        self.names = tuple(model.parameters)
        items = tuple(model.parameters.values())
        self.low = np.array([item.low for item in items])
        self.high = np.array([item.high for item in items])
        self.start = np.array([item.start for item in items])
        self.logarithmic = np.array([item.is_logarithmic for item in items])
        self._sizes = (len(model.states), len(model.inputs), len(model.outputs), max(len(model.quantities), 1))
        self.kernels: Kernels = build_kernels(model.rhs, model.output, model.quantity, *self._sizes, self.names)
        self._type = [(name, np.float64) for name in self.names]

    def pack(self, rows: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        """Return parameters [k, q] as a structured array [k]."""
        packed = np.zeros(len(rows), dtype=self._type)
        for column, name in enumerate(self.names):
            packed[name] = rows[:, column]
        return packed

    def initial_state(self, record: Record, parameters: FloatArray) -> FloatArray:
        """Return the states [n] at the start of a record."""
        rows = record.first_outputs
        p = self.pack(parameters[None, :]).view(np.recarray)[0]
        for first in (rows, rows[0]):
            try:
                values = [np.asarray(each, dtype=np.float64) for each in self.model.initial(first, p)]
            except (TypeError, IndexError, ValueError):
                continue
            if len(values) == len(self.model.states) and all(each.size == 1 for each in values):
                return np.array([each.item() for each in values])
        raise InputError("model.initial", "another result", f"a list of {len(self.model.states)} numbers")

    def run(
        self, record: Record, point: Point, gains: FloatArray | None = None, start: FloatArray | float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return predicted outputs [m, o] and states [m, n], which follow the data if there are gains [m, n, o].

        The states of memories follow those of the model. start: [n] added to the first state
        """
        work = self._allocate(point)
        m, n, o = len(record.t_s), work[0].shape[1], len(self.model.outputs)
        predicted, states = np.zeros((m, o)), np.zeros((m, n))
        x0 = self.initial_state(record, point.parameters) + start
        gains = np.zeros((m, n, o)) if gains is None else gains
        p, values = self.pack(point.parameters[None, :]), point.terms.values
        self.kernels.run(self._fix(record, point), x0, p, values, gains, work, predicted, states)
        return predicted, states

    def _fix(self, record: Record, point: Point) -> tuple[object, ...]:
        samples = (record.t_s, record.inputs, record.slopes, record.outputs)
        return (*samples, point.terms.table, self.h_max, self.hold)

    def _allocate(self, point: Point) -> tuple[FloatArray, ...]:
        return allocate_work(self._sizes[0] + len(point.terms.memories), *self._sizes[1:])

    def linearise(
        self,
        record: Record,
        point: Point,
        scales: FloatArray,
        noise_rate: FloatArray,
        noise: FloatArray,
        start_sigma: FloatArray,
    ) -> tuple[Linearisation, FloatArray]:
        """Return the filter's linearisation and the derivatives [n, q] of the first state by all free numbers."""
        columns = self.free_columns(point)
        ps, values, deltas, starts = [point.parameters], [point.terms.values], [], []
        x0 = self.initial_state(record, point.parameters)
        for kind, position in columns:
            parameters, numbers = point.parameters.copy(), point.terms.values.copy()
            if kind == "parameter":
                delta = STEP * max(abs(parameters[position]), 1e-3 * (self.high - self.low)[position])
                parameters[position] += delta
                starts.append((self.initial_state(record, parameters) - x0) / delta)
            else:
                row, column = divmod(position, 4)
                delta = STEP * max(abs(numbers[row, column]), 1e-12)
                numbers[row, column] += delta
                starts.append(np.zeros(len(x0)))
            ps.append(parameters)
            values.append(numbers)
            deltas.append(delta)
        work, rows = self._allocate(point), point.terms.table[point.terms.memories]
        sources = np.concatenate([scales, np.abs(record.inputs).max(axis=0, initial=0.0), np.ones(1 + self._sizes[3])])
        inner = np.array([1.0 if row[MEMORY] in PATH else sources[row[VARIABLE]] or 1.0 for row in rows])
        silent = np.zeros(len(rows))
        out = Linearisation.allocate(len(record.t_s), len(x0) + len(rows), len(noise), len(columns))
        variances = np.concatenate([noise_rate, silent]), noise, np.concatenate([start_sigma**2, silent])
        sizes = np.concatenate([scales, inner])
        packed, tables, steps = self.pack(np.array(ps)), np.array(values), np.array(deltas)
        self.kernels.linearise(self._fix(record, point), x0, packed, tables, steps, sizes, variances, work, out)
        first = np.array(starts).T.reshape(len(x0), len(columns))
        return out, np.concatenate([first, np.zeros((len(rows), len(columns)))])

    def list_variables(self, record: Record, point: Point, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return all variables [m, v] at the samples, and as they are on arrival there, with the inputs held before."""
        arriving = record.inputs
        if self.hold == 0:
            arriving = np.concatenate([record.inputs[:1], record.inputs[:-1]])
        tables = []
        for inputs in (record.inputs, arriving):
            derived = np.zeros((len(states), max(len(self.model.quantities), 1)))
            packed = self.pack(point.parameters[None, :])
            self.kernels.describe(record.t_s, states, np.ascontiguousarray(inputs), packed, derived)
            own = states[:, : self._sizes[0]]
            tables.append(np.column_stack([own, inputs, record.t_s, derived[:, : len(self.model.quantities)]]))
        return tables[0], tables[1]

    def find_parametrised(self, record: Record, states: FloatArray, point: Point) -> list[int]:
        """Return the states whose equation a parameter changes directly, at some of the states [m, n] of a record."""
        found = set[int]()
        for k in np.linspace(0, len(states) - 1, 20).astype(int):
            rows = [point.parameters]
            for position in range(len(self.names)):
                rows.append(point.parameters.copy())
                rows[-1][position] *= 1.01
                rows[-1][position] += 1e-3 * (self.high - self.low)[position] * (rows[-1][position] == 0.0)
            packed = self.pack(np.array(rows)).view(np.recarray)
            rates = [
                np.array(
                    self.model.rhs(record.t_s[k], states[k, : self._sizes[0]], record.inputs[k], p), dtype=np.float64
                )
                for p in packed
            ]
            found |= {int(s) for rate in rates[1:] for s in np.flatnonzero(rate != rates[0])}
        return sorted(found)

    def free_columns(self, point: Point) -> list[tuple[str, int]]:
        """Return the fitted numbers, parameters by index and those of terms by flat index."""
        return [("parameter", k) for k in range(len(self.names))] + [
            ("term", int(k)) for k in np.flatnonzero(point.terms.free.ravel())
        ]

    def to_vector(self, point: Point) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the fitted numbers and their limits, logarithms where declared so."""

        def join(parameters: FloatArray, numbers: FloatArray) -> FloatArray:
            head = parameters.copy()
            head[self.logarithmic] = np.log(head[self.logarithmic])
            return np.concatenate([head, numbers[point.terms.free]])

        terms = point.terms
        return join(point.parameters, terms.values), join(self.low, terms.low), join(self.high, terms.high)

    def from_vector(self, vector: FloatArray, point: Point) -> Point:
        """Return the point with these fitted numbers."""
        count = len(self.names)
        parameters = vector[:count].copy()
        parameters[self.logarithmic] = np.exp(parameters[self.logarithmic])
        values = point.terms.values.copy()
        values[point.terms.free] = vector[count:]
        return Point(parameters, replace(point.terms, values=values))


def fit(
    simulation: Simulation,
    records: Sequence[Record],
    point: Point,
    weights: Sequence[FloatArray],
    gains: Gains = None,
    evaluations: int = 30,
) -> tuple[Point, float]:
    """Return the point that minimises the weighted squared prediction errors, and their sum.

    weights: [m, o] per record, 0 where a sample does not count; gains: as of `Simulation.run`, None for free runs
    """
    used = [np.isfinite(r.outputs) & (w > 0.0) for r, w in zip(records, weights, strict=True)]
    # What follows the last sample that counts need not be simulated.
    parts_used = []
    for k, (record, mask) in enumerate(zip(records, used, strict=True)):
        if mask.any():
            part = record.cut(int(np.flatnonzero(mask.any(axis=1))[-1]) + 1)
            end = len(part.t_s)
            parts_used.append((part, None if gains is None else gains[k], weights[k][:end], mask[:end]))

    def residuals(vector: FloatArray) -> FloatArray:
        trial = simulation.from_vector(vector * unit, point)
        parts = []
        for record, gain, weight, mask in parts_used:
            predicted, _ = simulation.run(record, trial, gain)
            error = weigh(record, record.outputs - predicted, weight)[mask]
            parts.append(np.nan_to_num(np.clip(error, -DIVERGED, DIVERGED), nan=DIVERGED))
        return np.concatenate(parts)

    vector, low, high = simulation.to_vector(point)
    span = np.where(np.isfinite(high - low), high - low, 0.0)
    # In units of themselves: an amplitude of 1e-6 would else count as settled beside a threshold of 10.
    unit = np.maximum(np.abs(vector), np.maximum(1e-6 * span, 1e-12))
    start = np.clip(vector, low + 1e-9 * span, high - 1e-9 * span)
    found = fit_residuals(
        residuals,
        start / unit,
        (low / unit, high / unit),
        STEP,
        evaluations=evaluations,
        tolerance=TOLERANCE,
        # Free runs near the data have one minimum, which "dogbox" reaches in a few steps; filters have valleys.
        method="dogbox" if simulation.model.from_rest else "trf",
    )
    return simulation.from_vector(found.x * unit, point), found.chi2


def weigh(record: Record, errors: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the errors [m, o] of a record, or their columns [m, o, k], times the weights [m, o], whitened before."""
    if record.whiten is not None:
        measured = np.isfinite(record.outputs).reshape(*record.outputs.shape, *(1,) * (errors.ndim - 2))
        columns = np.where(measured, errors, 0.0)
        errors = record.whiten(columns.reshape(*record.outputs.shape, -1)).reshape(columns.shape)
    return errors * (weights if errors.ndim == 2 else weights[:, :, None])


def output_sizes(records: Sequence[Record]) -> FloatArray:
    """Return the standard deviation of each output [o] over all records."""
    joined = np.concatenate([r.outputs for r in records])
    sizes = np.array([np.std(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0 for c in joined.T])
    return np.where(sizes > 0.0, sizes, 1.0)


def run_errors(
    simulation: Simulation,
    records: Sequence[Record],
    point: Point,
    sizes: FloatArray,
    gains: Gains = None,
    start: FloatArray | float = 0.0,
) -> list[FloatArray]:
    """Return the errors [m, o] of each record, whitened or in units of sizes [o], 0 where nothing was measured.

    gains, start: as of `Simulation.run`, None for free runs
    """
    errors = []
    for k, record in enumerate(records):
        predicted, _ = simulation.run(record, point, None if gains is None else gains[k], start)
        error = weigh(record, record.outputs - predicted, np.broadcast_to(1.0 / sizes, predicted.shape))
        error = np.clip(np.nan_to_num(error, nan=DIVERGED), -DIVERGED, DIVERGED)
        errors.append(np.where(np.isfinite(record.outputs), error, 0.0))
    return errors


def choose_step(simulation: Simulation, records: Sequence[Record], point: Point) -> float:
    """Return the longest step, a sample's by a power of two, that halving does not change the free run by."""
    record = records[0]
    h = float(np.median(np.diff(record.t_s))) * (LONGEST_FROM_REST if simulation.model.from_rest else 1.0)
    probe = Record(record.t_s[:4000], record.inputs[:4000], record.outputs[:4000])
    size = output_sizes(records)
    tolerance = CONVERGED * (0.1 if simulation.model.from_rest else 1.0)
    before = Simulation(simulation.model, h, simulation.hold).run(probe, point)[0]
    for _ in range(7):
        after = Simulation(simulation.model, h / 2.0, simulation.hold).run(probe, point)[0]
        difference = np.abs(after - before) / size
        if np.isfinite(difference).all() and np.percentile(difference, 99) < tolerance:
            return h
        h, before = h / 2.0, after
    return h
