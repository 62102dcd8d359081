"""Parameters of terms, and the hypotheses by which a diagnosis searches for a term in recorded data."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import exp, log


@dataclass(frozen=True)
class TermParameter:
    """One parameter of a term: unit, default, plausible range and the source of that range.

    starts: values from which a search begins, the default alone if empty; a time constant that vanishes together with
    its effect needs several. is_shape: the parameter shapes the effect and does not scale it, so that a fit may end at
    either limit of the range. neutral: value without effect, which a parameter set need not state.
    """

    name: str
    unit: str
    default: float
    low: float
    high: float
    source: str
    starts: tuple[float, ...] = ()
    is_shape: bool = False
    neutral: float | None = None

    @property
    def if_omitted(self) -> float | None:
        """Value where a parameter set states none, which has no effect or is the default of a shape.

        None if it must be stated.
        """
        return self.default if self.neutral is None and self.is_shape else self.neutral


@dataclass(frozen=True)
class FreeParameter:
    """One number to be fitted: parameters of one term that share a value, more than one where they are tied."""

    key: str
    names: tuple[str, ...]
    parameter: TermParameter

    @property
    def label(self) -> str:
        """Name of the number in reports, `term.parameter`, or `term.all` where parameters are tied."""
        return f"{self.key}.{self.names[0] if len(self.names) == 1 else 'all'}"

    @property
    def logarithmic(self) -> bool:
        """Whether the logarithm is fitted, because the value cannot be zero."""
        return self.parameter.low > 0.0

    def read_value(self, terms: Mapping[str, Mapping[str, float]]) -> float:
        """Return the fitted number that these terms hold."""
        value = terms[self.key][self.names[0]]
        return log(value) if self.logarithmic else value

    def with_value(self, terms: Mapping[str, Mapping[str, float]], number: float) -> dict[str, dict[str, float]]:
        """Return the terms with another fitted number, clipped to the plausible range."""
        # e⁷⁰⁹ overflows; the clip below then takes the range's end.
        value = exp(min(number, 700.0)) if self.logarithmic else number
        value = min(max(value, self.parameter.low), self.parameter.high)
        out = {key: dict(values) for key, values in terms.items()}
        out[self.key] |= dict.fromkeys(self.names, value)
        return out

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of the fitted number."""
        low, high = self.parameter.low, self.parameter.high
        return (log(low), log(high)) if self.logarithmic else (low, high)

    @property
    def step(self) -> float:
        """Step of the fitted number for finite differences."""
        return 2e-3 if self.logarithmic else 1e-3 * (self.parameter.high - self.parameter.low)


@dataclass(frozen=True)
class Hypothesis:
    """One way in which a term may act.

    starts: values of the term's parameters from which a fit begins; free: the numbers that the fit changes.
    is_linear: the effect is proportional to each free number by itself, of either sign; else it scales with the first
    one. fit_every_start: every start is fitted, because no fit leads from one to another.
    """

    key: str
    label: str
    starts: tuple[dict[str, float], ...]
    free: tuple[FreeParameter, ...]
    is_linear: bool = False
    fit_every_start: bool = False

    @property
    def degrees(self) -> int:
        """Degrees of freedom."""
        return len(self.free)


@dataclass(frozen=True)
class RecordingScope:
    """Content of a recording, as far as hypotheses depend on it.

    signals: "temperature", "displacement", "force", "mirrors", those measured, in this order; pixels: the pixels
    measured; illuminated: pixels that received a pulse; has_neighbour_pulses: a measured pixel has runs in which
    another pixel is illuminated; power_levels: number of distinct pulse powers; runs: session time, from −1 to 1, and
    group of each run.
    """

    signals: tuple[str, ...]
    pixels: tuple[int, ...]
    illuminated: frozenset[int]
    has_neighbour_pulses: bool
    power_levels: int
    runs: tuple[tuple[float, str], ...] = ()

    def list_signal_sets(self, names: tuple[str, ...]) -> list[tuple[str, ...]]:
        """Return all of these signals together and, of a recording of several, each measured one alone."""
        measured = [(name,) for name in self.signals if name in names]
        return [names, *(measured if len(self.signals) > 1 else [])]

    def list_run_spans(self, *, with_steps: bool) -> list[tuple[float, float]]:
        """Return session times of the first and the last run of every run, of repeats in a row, and of all from one on.

        with_steps: whether with the latter
        """
        runs = sorted(self.runs)
        rows = range(len(runs))
        changes = [row for row in rows if row == 0 or runs[row][1] != runs[row - 1][1]]
        spans = [(row, row) for row in rows]
        spans += [(first, after - 1) for first, after in pairwise([*changes, len(runs)])]
        spans += [(row, len(runs) - 1) for row in rows[1:] if with_steps]
        whole = (0, len(runs) - 1)
        return [(runs[first][0], runs[last][0]) for first, last in dict.fromkeys(spans) if (first, last) != whole]

    @property
    def subsystem(self) -> str:
        """Return "mirrors" for a recording of mirror positions alone, else "pixels"."""
        return "mirrors" if set(self.signals) <= {"mirrors"} else "pixels"


def describe_signals(names: tuple[str, ...]) -> str:
    """Return the name of a set of signals in a hypothesis's label."""
    return "all signals" if len(names) > 1 else names[0]
