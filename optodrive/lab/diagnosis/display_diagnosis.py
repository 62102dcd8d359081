"""A whole display, each pixel for itself: its task, its answer, and what the answers have in common."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.core.types.measurements import Measurement
from optodrive.device.config import Config
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.noise_model import Coloured, whiten
from optodrive.lab.diagnosis.priors import TABLE, prior_of
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel_ode import Active, Scene, observe

TOGETHER = 4
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
    found: Discrepancy | None
    error: str = ""
    width_m: float | None = None


@dataclass(frozen=True)
class Spread:
    """A number over pixels."""

    median: float
    low: float
    high: float
    unit: str

    @classmethod
    def of(cls, values: list[float], unit: str) -> "Spread":
        """Median and range."""
        return cls(float(np.median(values)), min(values), max(values), unit)


@dataclass(frozen=True, eq=False)
class Group:
    """Pixels with the same verdict and causes. parameters: of named causes; gain: reductions on held-out runs."""

    verdict: str
    causes: tuple[str, ...]
    answers: tuple[PixelAnswer, ...]
    parameters: dict[str, Spread]
    gain: Spread | None

    @property
    def pixels(self) -> list[int]:
        """Sorted."""
        return sorted(item.pixel for item in self.answers if item.pixel is not None)


@dataclass(frozen=True, eq=False)
class DisplayAnswer:
    """All answers. pixels: by index; mirrors: where they were measured."""

    pixels: tuple[PixelAnswer, ...]
    mirrors: PixelAnswer | None
    seconds: float

    @property
    def failed(self) -> list[PixelAnswer]:
        """Pixels without an answer."""
        return [item for item in self.pixels if item.found is None]

    def groups(self) -> list[Group]:
        """Pixels that suffer from the same, most pixels first; nothing found is a group too."""
        found: dict[tuple[str, tuple[str, ...]], list[PixelAnswer]] = {}
        for item in self.pixels:
            if item.found is not None:
                found.setdefault((item.found.verdict, tuple(sorted(item.found.causes))), []).append(item)
        groups = [_group(*key, tuple(members)) for key, members in found.items()]
        return sorted(groups, key=lambda item: (-len(item.answers), item.verdict, item.causes))

    def model(self) -> tuple[Discrepancy | None, float | None, str]:
        """One pixel model for the display, its bridge width, and what it stands for; or None and why there is none.

        Medians over the pixels of the largest group, if that is more than half of all and has a definite verdict.
        """
        groups = self.groups()
        most = groups[0] if groups else None
        if most is None or 2 * len(most.answers) <= len(self.pixels):
            return None, None, "no one set of causes holds for most pixels"
        if most.verdict not in ("none", "cause"):
            return None, None, f"most pixels are {most.verdict}"
        widths = {item.width_m for item in most.answers}
        if len(widths) > 1:
            return None, None, "the pixels' bridges differ in width"
        each = [item.found for item in most.answers if item.found is not None and item.found.base]
        first = each[0]
        base = {name: _median(item.base[name] for item in each) for name in first.base}
        terms = {
            key: {name: _median(item.terms[key][name] for item in each) for name in own}
            for key, own in first.terms.items()
        }
        what = f"medians over {len(each)} of {len(self.pixels)} pixels"
        return replace(first, base=base, terms=terms), widths.pop(), what


def diagnose_pixel(task: PixelTask) -> PixelAnswer:
    """One task done; bad data become its error."""
    try:
        measurement = task.read()
        prior, epsilon, width_m = prior_of(measurement, task.config)
        found = diagnose(measurement, task.seed, prior, epsilon)
    except InputError as error:
        return PixelAnswer(task.pixel, None, str(error))
    return PixelAnswer(task.pixel, replace(found, courses=()), width_m=width_m)


def warm() -> None:
    """Compile what a diagnosis needs, so that workers find it compiled."""
    t_s = np.array([0.01, 0.02])
    scene = Scene(np.array([[0.0, 0.01, 1.0, 0.0]]), 0, 293.15, (t_s, t_s, t_s))
    observe(scene, load_parameters(TABLE).pixel(4e-4), Active.of({}))
    whiten(t_s, np.ones((2, 1)), Coloured(1.0, (1.0, 1.0), (0.01, 1.0)))


def _group(verdict: str, causes: tuple[str, ...], answers: tuple[PixelAnswer, ...]) -> Group:
    each = [item.found for item in answers if item.found is not None]
    values: dict[str, list[float]] = {}
    units: dict[str, str] = {}
    for found in each if verdict == "cause" else ():
        for name, item in found.parameters.items():
            if "." in name:
                values.setdefault(name, []).append(item.value)
                units[name] = item.unit
    gains = [found.gain.reduction for found in each if found.gain is not None]
    parameters = {name: Spread.of(own, units[name]) for name, own in values.items()}
    return Group(verdict, causes, answers, parameters, Spread.of(gains, "1") if gains else None)


def _median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))
