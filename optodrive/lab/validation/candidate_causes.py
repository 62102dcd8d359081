"""Hypotheses on the errors of Text S1, each with one free parameter within physical limits."""

from dataclasses import dataclass
from math import exp, log


@dataclass(frozen=True)
class ParameterRange:
    """Plausible range of a parameter: equally likely throughout, by its logarithm if the range excludes zero."""

    symbol: str
    unit: str
    low: float
    high: float

    def compute_value(self, fraction: float) -> float:
        """Return the parameter at a fraction of its range, 0 to 1."""
        if self.low > 0.0:
            return exp(log(self.low) + fraction * log(self.high / self.low))
        return self.low + fraction * (self.high - self.low)


@dataclass(frozen=True)
class CauseHypothesis:
    """Hypothesis on an error of Text S1, with one free parameter.

    source: of the range; deciding_measurement: the measurement that would confirm it; excludes: causes for the same
    quantity, which make no sense together; replaces_law: it replaces a law of the nominal model that no value of its
    parameter reproduces
    """

    key: str
    description: str
    parameter: ParameterRange
    source: str
    deciding_measurement: str
    excludes: tuple[str, ...] = ()
    replaces_law: bool = False


GAS_CAUSES, LIFT_CAUSES, FORCE_CAUSES = (
    ("gas_membrane", "gas_share"),
    ("membrane_plate", "gas_membrane"),
    ("force_area", "load_cell_gives"),
)
THERMAL_MEASUREMENT = "the absorber's temperature during a pulse and the cooling after it, at three powers"

CAUSES = (
    CauseHypothesis(
        "gas_lag",
        "the gas lags the absorber by a time constant other than R_air C_air / 2",
        ParameterRange("tau_g", "s", 1e-3, 0.1),
        "conduction over half the cavity, 1.2 ms, to 64 ms of Text S1 and slower corners",
        "displacement at 10 kHz through the first 10 ms of a pulse",
    ),
    CauseHypothesis(
        "gas_share",
        "the gas settles at a share of the absorber's rise other than half",
        ParameterRange("share", "1", 0.1, 0.5),
        "half at most, conduction both ways",
        "pressure in a closed cavity together with displacement",
        GAS_CAUSES,
    ),
    CauseHypothesis(
        "membrane_plate",
        "the constant of the membrane's plate formula differs from 3/1280",
        ParameterRange("kappa_factor", "1", 0.05, 80.0),
        "3/16 of a clamped plate is 80 times as much; the added gas volume compensates part of it",
        "displacement against a known static pressure, to 1 mm",
        LIFT_CAUSES,
    ),
    CauseHypothesis(
        "gas_membrane",
        "the membrane stretches and the gas volume grows: neither plate nor constant volume",
        ParameterRange("share", "1", 0.1, 0.5),
        "half at most, conduction both ways; E, ν, h, r, V are the paper's",
        "displacement against a known static pressure, to 1 mm",
        (*LIFT_CAUSES, *GAS_CAUSES),
        replaces_law=True,
    ),
    CauseHypothesis(
        "force_area",
        "the blocked force was measured on less than the whole aperture",
        ParameterRange("area", "m^2", 0.1e-6, 7.07e-6),
        "at most the aperture",
        "blocked force with probes of two areas, and the pressure in the cavity beside it",
        FORCE_CAUSES,
    ),
    CauseHypothesis(
        "load_cell_gives",
        "the blocked membrane yielded: the gas volume grew against the load cell",
        ParameterRange("compliance", "m^3/Pa", 1e-14, 1e-11),
        "volume per pascal: 0.08 µL to several cavities at 8 kPa",
        "blocked force with probes of two areas, and the pressure in the cavity beside it",
        FORCE_CAUSES,
    ),
    CauseHypothesis(
        "absorber_resistance",
        "all bridge resistances are wrong by one factor",
        ParameterRange("r_factor", "1", 0.7, 1.4),
        "R was fitted to the first 30 ms of a longer rise",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "absorber_capacity",
        "all heat capacities of the absorbers are wrong by one factor",
        ParameterRange("c_factor", "1", 0.7, 1.4),
        "the gas's share of 10 %, and C scattered by 16 %",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "absorbed_power",
        "the absorbed power is wrong by one factor",
        ParameterRange("power_factor", "1", 0.8, 1.2),
        "2.45 W or 2.5 W, two estimates of the absorption",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "bridge_conductivity",
        "the bridges conduct worse when hot",
        ParameterRange("exponent", "1", 0.0, 1.3),
        "k ~ 1/T is 1 (Text S2)",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "radiation",
        "the hot absorber radiates",
        ParameterRange("emitting_area", "m^2", 0.0, 2e-5),
        "both faces of absorber and bridges",
        THERMAL_MEASUREMENT,
    ),
    CauseHypothesis(
        "wall_heating",
        "the wall at the outer end of the bridges warms up",
        ParameterRange("resistance", "K/W", 0.0, 40.0),
        "a cell of the laminate to its surroundings, 1.2 s with its capacity",
        "displacement through a train of seconds",
    ),
    CauseHypothesis(
        "panel_heating",
        "the whole panel around the walls warms up",
        ParameterRange("resistance", "K/W", 0.0, 60.0),
        "still air around 162 × 162 mm, 2 K/W, to a sample of 30 × 30 mm; 200 s with its capacity",
        "displacement of a pixel without light through ten minutes of light on another",
    ),
    CauseHypothesis(
        "laser_late",
        "the light of every pulse starts late",
        ParameterRange("delay", "s", 1e-5, 2.4e-3),
        "driver and diode, 0.02 to 3 ms, less at 200 Hz; a ramp loses as much energy as a delay",
        "a photodiode beside the sample",
    ),
    CauseHypothesis(
        "dead_time",
        "a pixel rate includes time without light per pulse: move and settling of the mirrors",
        ParameterRange("dead_time", "s", 1e-4, 5e-3),
        "small steps of low-cost mirrors 0.3 ms, large steps several ms; the paper states pulse times only",
        "pixel rates at two pixel distances, with mirror positions",
    ),
    CauseHypothesis(
        "rate_pixel",
        "the pixel rates belong to a bridge width other than 0.55 mm",
        ParameterRange("width", "m", 0.2e-3, 0.75e-3),
        "the widths of Table S3",
        "displacement against pulse width on the pixel of Fig. 3F",
    ),
    CauseHypothesis(
        "rate_power",
        "the pixel rates were taken with less than full power",
        ParameterRange("power_factor", "1", 0.3, 1.0),
        "Fig. 3F states full power; the scanning optics attenuate it",
        "power at the sample during the scan of Fig. 3F",
    ),
)
"""All causes that can be identified."""

CAUSES_BY_KEY = {cause.key: cause for cause in CAUSES}
