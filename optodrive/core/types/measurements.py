"""Pixel traces and recordings of measured signals."""

from dataclasses import dataclass, field

from optodrive.core.types.arrays import FloatArray, IntArray, freeze_arrays


@dataclass(frozen=True, eq=False)
class PixelTrace:
    """What pixels do in time. t_s [m]; absorber_k, gas_k (rises above ambient), displacement_m, force_n: [m, p]."""

    t_s: FloatArray
    pixel: IntArray
    absorber_k: FloatArray
    gas_k: FloatArray
    displacement_m: FloatArray
    force_n: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True, eq=False)
class Signal:
    """One measured signal of one pixel: t_s [m] increasing; value [m], NaN where missing; sigma: stated noise."""

    pixel: int
    t_s: FloatArray
    value: FloatArray
    sigma: float | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True, eq=False)
class Run:
    """One run of a recording: the drive as commanded, and the signals measured meanwhile.

    pulses: [n, 4] start_s, width_s, power_w, pixel; signals: by the format's names; attributes: as in the file
    """

    name: str
    ambient_k: float
    pulses: FloatArray
    signals: dict[str, Signal]
    attributes: dict[str, str | float] = field(default_factory=dict)
    commands: FloatArray | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True)
class Measurement:
    """A recording: runs in order."""

    runs: tuple[Run, ...]
