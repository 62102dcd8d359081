"""Diagnosis of a whole display pixel by pixel: task, answer, and groups of equal answers."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.core.types.measurements import Measurement
from optodrive.device.config import Config
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.noise_model import ColouredNoise, whiten
from optodrive.lab.diagnosis.nominal_fit import DEFAULT_PARAMETER_SET, build_prior
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

MAX_JOINT_PIXELS = 4
"""Maximum number of pixels that are fitted together with one set of parameters; more are fitted separately."""


@dataclass(frozen=True)
class PixelTask:
    """Diagnosis of one pixel, for any worker.

    pixel: `MIRRORS` for the mirrors
    read: reads the pixel's runs
    use: kinds of findings of the inspection that leave nothing out
    """

    pixel: int
    read: Callable[[], Measurement]
    seed: int = 0
    config: Config | None = None
    use: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PixelAnswer:
    """Diagnosis of one pixel without residual traces, or the error that prevented it.

    pixel: `MIRRORS` for the mirrors; width_m: if known
    """

    pixel: int
    discrepancy: Discrepancy | None
    error: str = ""
    width_m: float | None = None


@dataclass(frozen=True)
class PixelSpread:
    """Median and range of a value over pixels."""

    median: float
    low: float
    high: float
    unit: str

    @classmethod
    def from_values(cls, values: Iterable[float], unit: str = "1") -> "PixelSpread | None":
        """Return median and range of values, None without any."""
        found = list(values)
        return cls(float(np.median(found)), min(found), max(found), unit) if found else None


NOMINAL = ("none", "instrument", "undecided")
"""Verdicts with which a pixel keeps the nominal model."""


@dataclass(frozen=True, eq=False)
class PixelGroup:
    """Pixels with the same verdict and causes, each with its diagnosis."""

    verdict: str
    causes: tuple[str, ...]
    members: tuple[tuple[PixelAnswer, Discrepancy], ...]

    @property
    def parameters(self) -> dict[str, PixelSpread]:
        """Parameters of the named causes."""
        values: dict[tuple[str, str], list[float]] = {}
        for _, found in self.members if self.verdict == "cause" else ():
            for name, item in found.parameters.items():
                if "." in name:
                    values.setdefault((name, item.unit), []).append(item.value)
        spreads = {name: PixelSpread.from_values(numbers, unit) for (name, unit), numbers in values.items()}
        return {name: spread for name, spread in spreads.items() if spread is not None}

    @property
    def gain(self) -> PixelSpread | None:
        """Reduction of the error on held-out runs."""
        return PixelSpread.from_values(found.gain.reduction for _, found in self.members if found.gain is not None)

    @property
    def height_error(self) -> PixelSpread | None:
        """Rms error of planned heights, on held-out pushes where there are any."""
        errors = (found.height_error_held_out or found.height_error_fitted for _, found in self.members)
        return PixelSpread.from_values(error.extended_rms for error in errors if error is not None)

    @property
    def doubtful(self) -> list[int]:
        """Indices of the pixels at which the size of a named cause is not established, sorted."""
        return sorted(item.pixel for item, found in self.members if found.doubts)

    @property
    def pixels(self) -> list[int]:
        """Pixel indices, sorted."""
        return sorted(item.pixel for item, _ in self.members)


@dataclass(frozen=True, eq=False)
class DisplayAnswer:
    """Answers of all pixels, sorted by index, and of the mirrors where they were measured."""

    pixels: tuple[PixelAnswer, ...]
    mirrors: PixelAnswer | None
    elapsed_s: float

    @property
    def discrepancies(self) -> list[Discrepancy]:
        """Diagnoses of the pixels that have one."""
        return [item.discrepancy for item in self.pixels if item.discrepancy is not None]

    @property
    def failed(self) -> list[PixelAnswer]:
        """Answers that are errors."""
        return [item for item in self.pixels if item.discrepancy is None]

    def build_groups(self) -> list[PixelGroup]:
        """Return the pixels grouped by verdict and causes, largest group first."""
        by_causes: dict[tuple[str, tuple[str, ...]], list[tuple[PixelAnswer, Discrepancy]]] = {}
        for item in self.pixels:
            if (found := item.discrepancy) is not None:
                by_causes.setdefault((found.verdict, tuple(sorted(found.causes))), []).append((item, found))
        groups = [PixelGroup(*key, tuple(members)) for key, members in by_causes.items()]
        return sorted(groups, key=lambda item: (-len(item.members), item.verdict, item.causes))

    def build_model(self) -> tuple[Discrepancy | None, float | None, str]:
        """Return one pixel model of the display, its bridge width and its description, or None, None and the reason.

        The model has the medians over the largest group, provided that it holds more than half of all pixels and names
        a cause or none; all pixels of which no error was found are one group.
        """
        groups = self.build_groups()
        nominal = [item for group in groups if group.verdict in NOMINAL for item in group.members]
        members = max([nominal, *(list(group.members) for group in groups)], key=len)
        if 2 * len(members) <= len(self.pixels):
            return None, None, "no set of causes holds for most pixels"
        if (verdict := members[0][1].verdict) not in (*NOMINAL, "cause"):
            return None, None, f"most pixels are {verdict}"
        widths_m = {item.width_m for item, _ in members}
        if len(widths_m) > 1:
            return None, None, "the bridge widths of the pixels differ"
        discrepancies = [found for _, found in members if found.base]
        first = discrepancies[0]
        base = {name: _compute_median(item.base[name] for item in discrepancies) for name in first.base}
        terms = {
            key: {name: _compute_median(item.terms[key][name] for item in discrepancies) for name in values}
            for key, values in first.terms.items()
        }
        estimator = f"medians over {len(discrepancies)} of {len(self.pixels)} pixels"
        return replace(first, base=base, terms=terms), widths_m.pop(), estimator


def diagnose_pixel(task: PixelTask) -> PixelAnswer:
    """Run one task. Invalid data yield an answer with an error."""
    try:
        measurement = task.read()
        prior, width_m = build_prior(measurement, task.config)
        discrepancy = diagnose(measurement, task.seed, prior, use=task.use)
    except InputError as error:
        return PixelAnswer(task.pixel, None, str(error))
    bare = replace(
        discrepancy, residual_traces=(), example_traces=(), held_out_traces=(), data_findings=discrepancy.omitted_data
    )
    return PixelAnswer(task.pixel, bare, width_m=width_m)


def compile_kernels() -> None:
    """Compile all kernels that a diagnosis needs, so that workers load them from the cache."""
    t_s = np.array([0.01, 0.02])
    experiment = PixelExperiment(np.array([[0.0, 0.01, 1.0, 0.0]]), 0, 293.15, (t_s, t_s, t_s))
    simulate_signals(experiment, load_parameters(DEFAULT_PARAMETER_SET).build_pixel(4e-4), ActiveTerms.from_values({}))
    whiten(t_s, np.ones((2, 1)), ColouredNoise(1.0, (1.0, 1.0), (0.01, 1.0)))


def _compute_median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))
