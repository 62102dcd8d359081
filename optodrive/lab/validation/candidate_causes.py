"""What Text S1 may have wrong: each a physical cause in words, with one number that is free within physical limits."""

from dataclasses import dataclass
from math import exp, log

import numpy as np


@dataclass(frozen=True)
class CauseHypothesis:
    """One hypothesis.

    words: what is wrong; symbol, unit, low, high: the number that is freed, and its plausible range, all alike likely
    (by its logarithm, unless none of it is possible); source: of the range; without: causes that speak of the same
    thing, so that both together mean nothing; settle: the measurement that would tell; instead: it takes the place of a
    law of the nominal model, which no value of its number gives back
    """

    key: str
    description: str
    symbol: str
    unit: str
    low: float
    high: float
    source: str
    deciding_measurement: str
    excludes: tuple[str, ...] = ()
    replaces_law: bool = False

    @property
    def logarithmic(self) -> bool:
        """Whether the number is fitted by its logarithm."""
        return self.low > 0.0

    def compute_value(self, fraction: float) -> float:
        """The number at a share of its range, 0 to 1."""
        if self.logarithmic:
            return exp(log(self.low) + fraction * log(self.high / self.low))
        return self.low + fraction * (self.high - self.low)

    def compute_fraction(self, value: float) -> float:
        """Where in its range a number is, 0 to 1."""
        if self.logarithmic:
            return float(np.clip(log(max(value, 1e-300) / self.low) / log(self.high / self.low), 0.0, 1.0))
        return float(np.clip((value - self.low) / (self.high - self.low), 0.0, 1.0))


GAS_CAUSES, LIFT_CAUSES, FORCE_CAUSES = (
    ("gas_membrane", "gas_share"),
    ("membrane_plate", "gas_membrane"),
    ("force_area", "load_cell_gives"),
)
THERMAL_MEASUREMENT = "the absorber's temperature through a pulse and the cooling after it, at three powers"

CAUSES = (
    CauseHypothesis(
        "gas_lag",
        "the gas follows the absorber in another time than R_air C_air / 2",
        "tau_g",
        "s",
        1e-3,
        0.1,
        "conduction over half the cavity, 1.2 ms, to Text S1's 64 ms and sluggish corners",
        "displacement at 10 kHz through the first 10 ms of a pulse",
    ),
    CauseHypothesis(
        "gas_share",
        "the gas settles at another share of the absorber's rise than half",
        "share",
        "1",
        0.1,
        0.5,
        "half at most, conduction both ways",
        "pressure in a closed cavity, beside displacement",
        GAS_CAUSES,
    ),
    CauseHypothesis(
        "membrane_plate",
        "the constant of the membrane's plate formula is another than 3/1280",
        "kappa_factor",
        "1",
        0.05,
        80.0,
        "3/16 of a clamped plate is 80 times as much; room for the gas takes some of it back",
        "displacement against a known static pressure, to 1 mm",
        LIFT_CAUSES,
    ),
    CauseHypothesis(
        "gas_membrane",
        "the membrane stretches and the gas makes room under it: no plate, no constant volume",
        "share",
        "1",
        0.1,
        0.5,
        "half at most, conduction both ways; E, ν, h, r, V are the paper's",
        "displacement against a known static pressure, to 1 mm",
        (*LIFT_CAUSES, *GAS_CAUSES),
        replaces_law=True,
    ),
    CauseHypothesis(
        "force_area",
        "the blocked force was felt on less than the whole aperture",
        "area",
        "m^2",
        0.1e-6,
        7.07e-6,
        "at most the aperture",
        "blocked force with probes of two areas, and the pressure in the cavity beside it",
        FORCE_CAUSES,
    ),
    CauseHypothesis(
        "load_cell_gives",
        "the blocked membrane gave way: the gas made room against the load cell",
        "compliance",
        "m^3/Pa",
        1e-14,
        1e-11,
        "volume a pascal: 0.08 µL to several cavities at 8 kPa",
        "blocked force with probes of two areas, and the pressure in the cavity beside it",
        FORCE_CAUSES,
    ),
    CauseHypothesis(
        "absorber_resistance",
        "the bridges' resistances are all off by one factor",
        "r_factor",
        "1",
        0.7,
        1.4,
        "R fitted on 30 ms of a rise that takes longer",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "absorber_capacity",
        "the absorbers' heat capacities are all off by one factor",
        "c_factor",
        "1",
        0.7,
        1.4,
        "the gas's share of 10 %, and C scattered by 16 %",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "absorbed_power",
        "the absorbed power is off by one factor",
        "power_factor",
        "1",
        0.8,
        1.2,
        "2.45 W or 2.5, absorption by two routes",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "bridge_conductivity",
        "the bridges conduct worse when hot",
        "exponent",
        "1",
        0.0,
        1.3,
        "k ~ 1/T is 1 (Text S2)",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "radiation",
        "the hot absorber radiates",
        "emitting_area",
        "m^2",
        0.0,
        2e-5,
        "both faces of absorber and bridges",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "wall_heating",
        "the wall at the bridges' far end warms",
        "resistance",
        "K/W",
        0.0,
        40.0,
        "a cell of the laminate to its surroundings, 1.2 s with its capacity",
        "displacement through a train of seconds",
    ),
    CauseHypothesis(
        "laser_late",
        "the light comes later than the pulse, in every pulse",
        "delay",
        "s",
        1e-5,
        2.4e-3,
        "driver and diode, 0.02 to 3 ms, but at 200 Hz there was some; a ramp misses as much energy as a delay",
        "a photodiode beside the sample",
    ),
    CauseHypothesis(
        "dead_time",
        "a pixel rate counts a time without light beside each pulse: the mirrors' move and settling",
        "dead_time",
        "s",
        1e-4,
        5e-3,
        "small steps of cheap mirrors 0.3 ms, long ones some ms; the paper speaks of pulse times alone",
        "pixel rates at two distances between pixels, with the mirrors' positions",
    ),
    CauseHypothesis(
        "rate_pixel",
        "the pixel rates are those of a pixel of another bridge width than 0.55 mm",
        "width",
        "m",
        0.2e-3,
        0.75e-3,
        "the widths of Table S3",
        "displacement against pulse width on the pixel of Fig. 3F",
    ),
    CauseHypothesis(
        "rate_power",
        "the pixel rates were taken with less than full power",
        "power_factor",
        "1",
        0.3,
        1.0,
        "Fig. 3F says full power; scanning optics in between lose some",
        "power at the sample while the pixels of Fig. 3F are scanned",
    ),
)
"""Every cause that can be named."""


def index_causes() -> dict[str, CauseHypothesis]:
    """By key."""
    return {cause.key: cause for cause in CAUSES}
