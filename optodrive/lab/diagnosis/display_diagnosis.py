"""A whole display, each pixel for itself: its task, its answer, and what the answers have in common."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.core.types.measurements import Measurement
from optodrive.device.config import Config
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.noise_model import ColouredNoise, whiten
from optodrive.lab.diagnosis.priors import DEFAULT_PARAMETER_SET, build_prior
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

MAX_JOINT_PIXELS = 4
"""So many pixels are fitted together, as one set of numbers; of more, each for itself."""


@dataclass(frozen=True)
class PixelTask:
    """One pixel to be diagnosed, wherever that is done. pixel: None for the mirrors; read: gives its own runs."""

    pixel: int | None
    read: Callable[[], Measurement]
    seed: int = 0
    config: Config | None = None


@dataclass(frozen=True, eq=False)
class PixelAnswer:
    """What was found, without courses; or why nothing was. width_m: the bridge's, where it is known."""

    pixel: int | None
    discrepancy: Discrepancy | None
    error: str = ""
    width_m: float | None = None


@dataclass(frozen=True)
class PixelSpread:
    """A number over pixels."""

    median: float
    low: float
    high: float
    unit: str

    @classmethod
    def from_values(cls, values: list[float], unit: str) -> "PixelSpread":
        """Median and range."""
        return cls(float(np.median(values)), min(values), max(values), unit)


@dataclass(frozen=True, eq=False)
class PixelGroup:
    """Pixels with the same verdict and causes. parameters: of named causes; gain: reductions on held-out runs."""

    verdict: str
    causes: tuple[str, ...]
    answers: tuple[PixelAnswer, ...]
    parameters: dict[str, PixelSpread]
    gain: PixelSpread | None

    @property
    def pixels(self) -> list[int]:
        """Sorted."""
        return sorted(item.pixel for item in self.answers if item.pixel is not None)


@dataclass(frozen=True, eq=False)
class DisplayAnswer:
    """All answers. pixels: by index; mirrors: where they were measured."""

    pixels: tuple[PixelAnswer, ...]
    mirrors: PixelAnswer | None
    elapsed_s: float

    @property
    def failed(self) -> list[PixelAnswer]:
        """Pixels without an answer."""
        return [item for item in self.pixels if item.discrepancy is None]

    def build_groups(self) -> list[PixelGroup]:
        """Pixels that suffer from the same, most pixels first; nothing found is a group too."""
        by_causes: dict[tuple[str, tuple[str, ...]], list[PixelAnswer]] = {}
        for item in self.pixels:
            if item.discrepancy is not None:
                by_causes.setdefault((item.discrepancy.verdict, tuple(sorted(item.discrepancy.causes))), []).append(
                    item
                )
        groups = [_build_group(*key, tuple(members)) for key, members in by_causes.items()]
        return sorted(groups, key=lambda item: (-len(item.answers), item.verdict, item.causes))

    def build_model(self) -> tuple[Discrepancy | None, float | None, str]:
        """One pixel model for the display, its bridge width, and what it stands for; or None and why there is none.

        Medians over the pixels of the largest group, if that is more than half of all and has a definite verdict.
        """
        groups = self.build_groups()
        largest = groups[0] if groups else None
        if largest is None or 2 * len(largest.answers) <= len(self.pixels):
            return None, None, "no one set of causes holds for most pixels"
        if largest.verdict not in ("none", "cause"):
            return None, None, f"most pixels are {largest.verdict}"
        widths_m = {item.width_m for item in largest.answers}
        if len(widths_m) > 1:
            return None, None, "the pixels' bridges differ in width"
        discrepancies = [
            item.discrepancy for item in largest.answers if item.discrepancy is not None and item.discrepancy.base
        ]
        first = discrepancies[0]
        base = {name: _compute_median(item.base[name] for item in discrepancies) for name in first.base}
        terms = {
            key: {name: _compute_median(item.terms[key][name] for item in discrepancies) for name in own}
            for key, own in first.terms.items()
        }
        estimator = f"medians over {len(discrepancies)} of {len(self.pixels)} pixels"
        return replace(first, base=base, terms=terms), widths_m.pop(), estimator


def diagnose_pixel(task: PixelTask) -> PixelAnswer:
    """One task done; bad data become its error."""
    try:
        measurement = task.read()
        prior, epsilon, width_m = build_prior(measurement, task.config)
        discrepancy = diagnose(measurement, task.seed, prior, epsilon)
    except InputError as error:
        return PixelAnswer(task.pixel, None, str(error))
    return PixelAnswer(task.pixel, replace(discrepancy, residual_traces=()), width_m=width_m)


def compile_kernels() -> None:
    """Compile what a diagnosis needs, so that workers find it compiled."""
    t_s = np.array([0.01, 0.02])
    experiment = PixelExperiment(np.array([[0.0, 0.01, 1.0, 0.0]]), 0, 293.15, (t_s, t_s, t_s))
    simulate_signals(experiment, load_parameters(DEFAULT_PARAMETER_SET).build_pixel(4e-4), ActiveTerms.from_values({}))
    whiten(t_s, np.ones((2, 1)), ColouredNoise(1.0, (1.0, 1.0), (0.01, 1.0)))


def _build_group(verdict: str, causes: tuple[str, ...], answers: tuple[PixelAnswer, ...]) -> PixelGroup:
    discrepancies = [item.discrepancy for item in answers if item.discrepancy is not None]
    values: dict[str, list[float]] = {}
    units: dict[str, str] = {}
    for discrepancy in discrepancies if verdict == "cause" else ():
        for name, item in discrepancy.parameters.items():
            if "." in name:
                values.setdefault(name, []).append(item.value)
                units[name] = item.unit
    gains = [found.gain.reduction for found in discrepancies if found.gain is not None]
    parameters = {name: PixelSpread.from_values(own, units[name]) for name, own in values.items()}
    return PixelGroup(verdict, causes, answers, parameters, PixelSpread.from_values(gains, "1") if gains else None)


def _compute_median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))
