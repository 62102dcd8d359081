"""Pixel traces, and recordings of measured signals."""

from dataclasses import dataclass, field

from optodrive.core.types.arrays import FloatArray, IntArray, ReadOnlyArrays

MIRRORS = -1
"""Index of the mirrors where that of a pixel is asked for."""


@dataclass(frozen=True, eq=False)
class PixelTrace(ReadOnlyArrays):
    """Simulated signals of p pixels over time.

    t_s: [m]; absorber_k and gas_k (rises above ambient), displacement_m, force_n: [m, p]
    """

    t_s: FloatArray
    pixel: IntArray
    absorber_k: FloatArray
    gas_k: FloatArray
    displacement_m: FloatArray
    force_n: FloatArray


@dataclass(frozen=True, eq=False)
class Signal(ReadOnlyArrays):
    """Measured signal of one pixel.

    t_s: [m] increasing; value: [m], NaN where missing; sigma: stated noise, if any
    """

    pixel: int
    t_s: FloatArray
    value: FloatArray
    sigma: float | None = None


@dataclass(frozen=True, eq=False)
class Run(ReadOnlyArrays):
    """Run of a recording: the drive as commanded and the signals measured meanwhile.

    pulses: [n, 4] start_s, width_s, power_w, pixel; signals: by the names of the recording format; attributes: as in
    the file; commands: [n, 3] t_s, x_rad, y_rad of the mirrors
    """

    name: str
    ambient_k: float
    pulses: FloatArray
    signals: dict[str, Signal]
    attributes: dict[str, str | float] = field(default_factory=dict)
    commands: FloatArray | None = None


@dataclass(frozen=True)
class Measurement:
    """Recording: runs in order."""

    runs: tuple[Run, ...]


@dataclass(frozen=True)
class DataFinding:
    """Finding of the inspection of a recording.

    signal: empty for all signals of the runs; action: "noted", "left out" or "refused"; samples: that it concerns;
    numbers: value and unit by name
    """

    runs: tuple[str, ...]
    signal: str
    kind: str
    text: str
    action: str = "noted"
    samples: int = 0
    numbers: dict[str, tuple[float, str]] = field(default_factory=dict)
