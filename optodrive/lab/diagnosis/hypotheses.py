"""What may be wrong: each cause as terms with values to begin with, and what of them is free."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from math import exp, log

import numpy as np

from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset
from optodrive.physics.term import TermParameter
from optodrive.physics.terms import discover_terms

CAUSE_KEYS = tuple(key for key, term in discover_terms().items() if term.signature)
"""Every cause that can be named."""


@dataclass(frozen=True)
class FreeParameter:
    """One number to be fitted: the parameters of a term that take it (more than one where they are tied)."""

    key: str
    names: tuple[str, ...]

    @property
    def parameter(self) -> TermParameter:
        """Of the first name."""
        return next(item for item in discover_terms()[self.key].parameters if item.name == self.names[0])

    @property
    def label(self) -> str:
        """As in the answer."""
        return f"{self.key}.{self.names[0] if len(self.names) == 1 else 'all'}"

    @property
    def logarithmic(self) -> bool:
        """Fitted by its logarithm: what cannot be zero."""
        return self.parameter.low > 0.0

    def read_value(self, terms: Mapping[str, Mapping[str, float]]) -> float:
        """The fitted number."""
        value = terms[self.key][self.names[0]]
        return log(value) if self.logarithmic else value

    def with_value(self, terms: Mapping[str, Mapping[str, float]], number: float) -> dict[str, dict[str, float]]:
        """Terms with another fitted number, held to its plausible range."""
        value = exp(min(number, 700.0)) if self.logarithmic else number
        value = float(np.clip(value, self.parameter.low, self.parameter.high))
        out = {key: dict(own) for key, own in terms.items()}
        out[self.key] |= dict.fromkeys(self.names, value)
        return out

    @property
    def step(self) -> float:
        """For differences."""
        return 2e-3 if self.logarithmic else 1e-3 * (self.parameter.high - self.parameter.low)


@dataclass(frozen=True)
class Hypothesis:
    """One way a cause may act. starts: values of its term to begin with; free: what is fitted of them.

    linear: its effect grows with each free number by itself, either sign; else with the first start's size. every: each
    start is tried in a fit, for none leads to the others.
    """

    key: str
    label: str
    starts: tuple[dict[str, float], ...]
    free: tuple[FreeParameter, ...]
    is_linear: bool = False
    fit_every_start: bool = False

    @property
    def degrees(self) -> int:
        """Of freedom."""
        return len(self.free)


SEARCH_GRIDS: dict[str, dict[str, tuple[float, ...]]] = {
    "wall_heating": {"resistance": (8.0,), "capacity": (0.02, 0.08, 0.3, 1.0)},
    "neighbour_crosstalk": {"share": (0.02,), "lag": (0.003, 0.03, 0.2)},
    "laser_turn_on": {"time": (1e-4, 4e-4, 1.5e-3)},
    "laser_droop": {"share": (0.08,), "time": (5e-3, 0.03, 0.2, 1.0), "spread": (1.5,)},
    "sensor_lag": {"time": (1e-4, 5e-4, 2e-3), "delay_share": (0.0, 0.7)},
    "membrane_creep": {"share": (0.1,), "time": (0.012, 0.05, 0.25, 1.0), "spread": (1.5,)},
    "membrane_stiffening": {"curvature": (2e-3,), "order": (1.0, 2.0)},
    "gas_leak": {"rate": (0.3, 2.0, 8.0)},
    "mirror_lag": {
        "frequency": (1000.0, 300.0, 450.0, 700.0, 1500.0, 2200.0, 3300.0, 5000.0),
        "damping": (0.6, 0.35, 0.9),
        "delay": (0.0, 5e-5, 1.5e-4, 4e-4),
        "slew": (5000.0, 60.0, 150.0, 400.0),
    },
}
"""Where a search begins; a time constant that vanishes with its effect needs several."""


def build_hypotheses(data: Dataset) -> list[Hypothesis]:
    """Every hypothesis that this data could show at all."""
    found: list[Hypothesis] = []
    measured = data.pixels
    pulsed = {int(pixel) for run in data.runs for pixel in run.pulses[:, 3]}
    mirrors = all(kind in MIRROR_KINDS for kind in data.kinds)
    powers = {round(float(power), 3) for run in data.runs for power in run.pulses[:, 2]}
    for key in CAUSE_KEYS:
        names = [item.name for item in discover_terms()[key].parameters]
        if key == "neighbour_crosstalk" and not any(
            (scene.pulses[:, 3] != scene.pixel).any() for scene, _ in data.experiments
        ):
            continue
        if key not in ("mirror_lag", "clock_offset") if mirrors else key == "mirror_lag":
            continue
        if key == "clock_offset":
            found += _build_clock_hypotheses(data)
        elif key == "beam_misalignment":
            for pixel in [item for item in measured if item in pulsed] if len(measured) > 1 else []:
                start = {"share": 0.1, "pixel": float(pixel), "resistance": 4.0, "time": 0.5}
                parameters = tuple(FreeParameter(key, (name,)) for name in ("share", "resistance", "time"))
                found.append(Hypothesis(key, f"{key} of pixel {pixel}", (start,), parameters))
        elif key == "power_nonlinearity":
            for name, size in (("threshold", 0.1), ("curvature", 0.1)) if len(powers) > 1 else ():
                start = dict.fromkeys(names, 0.0) | {name: size}
                found.append(
                    Hypothesis(key, f"{key}: {name}", (start,), (FreeParameter(key, (name,)),), name == "curvature")
                )
        elif key == "sensor_scale":
            # Its gain is R, C and kappa together: without a reference temperature no data shows it.
            start = {"gain": 1.0, "offset": 1.0}
            found.append(Hypothesis(key, f"{key}: offset", (start,), (FreeParameter(key, ("offset",)),), True))
        elif key == "ambient_drift":
            for free in (("offset",), ("offset", "ramp", "bend"), ("offset", "ramp", "bend", "rate"), ("rate",)):
                starts = tuple(dict.fromkeys(names, 0.0) | {name: 1.0} for name in free)
                found.append(
                    Hypothesis(key, f"{key}: {free[-1]}", starts, tuple(FreeParameter(key, (n,)) for n in free), True)
                )
        else:
            defaults = {item.name: (item.default,) for item in discover_terms()[key].parameters}
            grid = defaults | SEARCH_GRIDS.get(key, {})
            starts = tuple(dict(zip(grid, values, strict=True)) for values in product(*grid.values()))
            found.append(
                Hypothesis(
                    key,
                    key,
                    starts,
                    tuple(FreeParameter(key, (name,)) for name in names),
                    is_linear=key == "absorber_ageing",
                    fit_every_start=key == "mirror_lag",
                )
            )
    return found


def _build_clock_hypotheses(data: Dataset) -> list[Hypothesis]:
    key, signals = "clock_offset", ("temperature", "displacement", "force", "mirrors")
    present = list(dict.fromkeys(signals[min(kind, 3)] for kind in data.kinds))
    zero = dict.fromkeys(signals, 0.0)
    tied = [signals, *((name,) for name in present if len(present) > 1)]
    return [
        Hypothesis(
            key,
            f"{key} of {'all signals' if len(names) > 1 else names[0]}",
            (zero | dict.fromkeys(names, 2e-4),),
            (FreeParameter(key, names),),
            True,
        )
        for names in tied
    ]
