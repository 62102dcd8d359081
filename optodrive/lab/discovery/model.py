"""A small ODE simulation, measured records of the system, their files, and the answer of a discovery."""

import runpy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.numeric_tables import open_table
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.inference.claim import Claim, TermClaim

FIRST_ROWS = 100
"""Rows of measured outputs that `OdeModel.initial` receives at most."""


def no_quantity(t: Any, state: Any, u: Any, p: Any) -> Sequence[Any]:
    """Return one unused number: a model without quantities of its own."""
    return [0.0]


@dataclass(frozen=True)
class Parameter:
    """Number to be fitted: start and limits."""

    start: float
    low: float
    high: float

    @property
    def is_logarithmic(self) -> bool:
        """Whether the number is positive and known to a decade or worse, so that its logarithm is fitted."""
        return self.low > 0.0 and self.high >= 10.0 * self.low


@dataclass(frozen=True, eq=False)
class OdeModel:
    """Simulation dx/dt = rhs(t, state, u, p), y = output(state, u, p).

    rhs, output: return a list of numbers from time, s, the states, the inputs and the parameters, `p["name"]` or
    `p.name`; compiled if numba can, interpreted otherwise. initial: returns the states at the start of a record from
    its first measured outputs, [up to 100 samples, outputs] (of one sample, [outputs], if the function needs it so),
    and the parameters, of which some may occur only there. quantities: names of what `quantity` returns from the same
    arguments as `rhs`, further variables of a term; places: where a term may enter, what it depends on and what
    multiplies it ("" for nothing), everywhere by default; memories: beside such places, where a term may enter, whose
    past it depends on, and which kinds of memory; followers: states that follow others with a time constant of their
    own, as a memory does; from_rest: records begin in a known state, and inputs are constant from one sample to the
    next, as in pulses, so that no filter is needed to keep the states near the data
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    rhs: Callable[[Any, Any, Any, Any], Sequence[Any]]
    output: Callable[[Any, Any, Any], Sequence[Any]]
    initial: Callable[[Any, Any], Sequence[Any]]
    quantities: tuple[str, ...] = ()
    quantity: Callable[[Any, Any, Any, Any], Sequence[Any]] = no_quantity
    places: tuple[tuple[str, str, str], ...] = ()
    memories: tuple[tuple[str, str, tuple[int, ...]], ...] = ()
    followers: tuple[str, ...] = ()
    from_rest: bool = False

    def __post_init__(self) -> None:
        for field in ("states", "inputs", "outputs", "quantities"):
            object.__setattr__(self, field, tuple(getattr(self, field)))
        names = [*self.states, *self.inputs, *self.quantities]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise InputError("states, inputs and quantities", repeated, "every name once")
        if not self.states or not self.outputs or not self.parameters:
            raise InputError("model", (self.states, self.outputs), "at least one state, output and parameter")
        for name, item in self.parameters.items():
            if not item.low < item.high or not item.low <= item.start <= item.high:
                raise InputError(f"parameter {name}", (item.start, item.low, item.high), "low <= start <= high")

    @property
    def variable_names(self) -> tuple[str, ...]:
        """Quantities that a term can depend on: states, inputs, time, and those of the model."""
        return (*self.states, *self.inputs, "t", *self.quantities)

    def is_follower(self, variable: int) -> bool:
        """Return whether a variable is a state that follows another one."""
        return self.variable_names[variable] in self.followers

    @property
    def place_names(self) -> tuple[str, ...]:
        """Places where a term can enter: the equation of each state, each output."""
        return (*(f"d{name}/dt" for name in self.states), *self.outputs)


@dataclass(frozen=True, eq=False)
class Record:
    """Measured inputs [m, i] and outputs [m, o] at increasing times t_s [m]. An output that is NaN was not measured.

    whiten: linear map of errors [m, o, k], zero where nothing was measured, to errors of independent noise of one, in
    the same shape; what differs from record to record, such as a zero, is marginalised by it. Without it, noise is
    estimated and taken as white. name: by which the answer refers to the record
    """

    t_s: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    whiten: Callable[[FloatArray], FloatArray] | None = None
    name: str = ""

    def __post_init__(self) -> None:
        times = np.array(self.t_s, dtype=np.float64).reshape(-1)
        object.__setattr__(self, "t_s", times)
        for name in ("inputs", "outputs"):
            values = np.array(getattr(self, name), dtype=np.float64, order="C")
            if values.ndim == 1 and len(values) == len(times):
                values = values[:, None]
            if values.size == 0 and name == "inputs":
                values = np.zeros((len(times), 0))
            if values.ndim != 2 or len(values) != len(times):
                raise InputError(f"record.{name}", values.shape, f"[{len(times)}, columns], as many rows as t_s")
            object.__setattr__(self, name, values)
        if len(times) < 2 or not np.isfinite(times).all() or not (np.diff(times) > 0).all():
            raise InputError("record.t_s", f"{len(times)} values", "two or more finite, increasing times")
        if not np.isfinite(self.inputs).all():
            row = int(np.flatnonzero(~np.isfinite(self.inputs).all(axis=1))[0])
            raise InputError(f"record.inputs, row {row}", "not finite", "a number; only outputs may be missing")
        if np.isinf(self.outputs).any():
            raise InputError("record.outputs", "inf", "numbers, or NaN where nothing was measured")

    def cut(self, end: int) -> "Record":
        """Return the first samples, two or more, or the record itself where its errors are whitened as a whole."""
        if end == len(self.t_s) or self.whiten is not None:
            return self
        end = max(end, 2)
        first = replace(self, t_s=self.t_s[:end], inputs=self.inputs[:end], outputs=self.outputs[:end])
        first.__dict__["slopes"] = self.slopes[:end]  # of the whole record
        return first

    def check(self, model: OdeModel) -> None:
        """Refuse a record whose columns are not those of the model."""
        for name, values, names in (("inputs", self.inputs, model.inputs), ("outputs", self.outputs, model.outputs)):
            if values.shape[1] != len(names):
                raise InputError(f"record.{name}", values.shape[1], f"{len(names)} columns: {', '.join(names)}")

    @cached_property
    def slopes(self) -> FloatArray:
        """Derivatives of the inputs [m, i] at the samples, of a cubic spline."""
        if self.inputs.shape[1] == 0 or len(self.t_s) < 4:
            return np.zeros_like(self.inputs)
        from scipy.interpolate import CubicSpline

        slopes: FloatArray = CubicSpline(self.t_s, self.inputs).derivative()(self.t_s)
        return np.ascontiguousarray(slopes)

    @property
    def first_outputs(self) -> FloatArray:
        """First measured rows [up to 100, o], each missing value replaced by the nearest one of its column."""
        rows = self.outputs[:FIRST_ROWS].copy()
        for column in rows.T:
            known = np.flatnonzero(np.isfinite(column))
            if len(known) == 0:
                column[:] = 0.0
            else:
                column[:] = np.interp(np.arange(len(column)), known, column[known])
        return rows


@dataclass(frozen=True, eq=False)
class Curve:
    """Term as a function of the quantity that it depends on, without a formula, with its 95 % band, each [n].

    evaluate: values at values [n] of the quantity, of the formula if there is one
    """

    x: FloatArray
    y: FloatArray
    low: FloatArray
    high: FloatArray
    evaluate: Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Finding:
    """Term that the simulation lacks.

    term: the claim on it; curve: against the first of its variables, or what it remembers of that, per unit of the
    second variable, if any; tested: range of each variable in all records, beyond which nothing is known of the term
    """

    term: TermClaim
    curve: Curve
    tested: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Discovery:
    """Answer of `discover`.

    findings: terms by which the simulation is extended; claim: of all, also where there is none; judged_by: what the
    search did not see; base_rmse, extended_rmse: root mean square error over all outputs in free run there, in units of
    noise for records that state it; noise: its expected size; parameters: of the extended model, fitted to everything;
    base_parameters: likewise without terms
    """

    findings: tuple[Finding, ...]
    claim: Claim
    judged_by: str
    base_rmse: float
    extended_rmse: float
    noise: float
    parameters: dict[str, float]
    base_parameters: dict[str, float]
    _simulate: Callable[[Record], FloatArray]

    def simulate(self, record: Record) -> FloatArray:
        """Return the outputs [m, o] of the extended model in free run from `initial`, NaN once it has diverged."""
        return self._simulate(record)


def load_model(path: Path) -> OdeModel:
    """Return `model` of a Python file, which is executed."""
    if not path.is_file():
        raise InputError(str(path), "no such file", "a Python file that defines model = OdeModel(...)")
    try:
        content = runpy.run_path(str(path))
    except InputError:
        raise
    except Exception as error:
        raise InputError(str(path), f"{type(error).__name__}: {error}", "a Python file that runs") from error
    model = content.get("model")
    if not isinstance(model, OdeModel):
        raise InputError(f"{path}: model", type(model).__name__, "an OdeModel of optodrive.lab.discovery")
    return model


def read_record(path: Path, model: OdeModel) -> Record:
    """Return the record of a CSV file whose header names t_s and the inputs and outputs of the model, in any order.

    Further columns are ignored; an empty cell of an output was not measured.
    """
    inputs = len(model.inputs)
    with open_table(path, ("t_s", *model.inputs, *model.outputs)) as columns:
        table = columns.read_numbers(missing=model.outputs)
    try:
        return Record(table[:, 0], table[:, 1 : 1 + inputs], table[:, 1 + inputs :], name=path.stem)
    except InputError as error:
        raise InputError(f"{path}: {error.where}", error.value, error.expected) from None
