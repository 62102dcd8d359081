"""Predictions of the measured facts by Text S1 with some of its hypothetical errors corrected."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from math import log, pi, sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.validation.facts import RATE_HEIGHTS_M, Datum
from optodrive.lab.validation.stimuli import (
    AMBIENT_K,
    LONG_PULSE_S,
    FrozenTerms,
    PulseStimulus,
    TrainStimulus,
    freeze_terms,
    pulse_rises_k,
    train_gas_k,
)
from optodrive.physics.paper_facts import load_paper_facts
from optodrive.physics.parameters import ParameterSet
from optodrive.physics.pixel import GAS_FRACTION, Pixel
from optodrive.physics.terms.mechanical import ATMOSPHERE_PA, equilibrium_height_m

CauseValues = Mapping[str, float]
"""Active causes and the parameter of each."""

WALL_TAU_S = 1.2
"""Relaxation time of the wall, as estimated in the shipped parameter set `surroundings`."""
PANEL_TAU_S = 185.0
"""Relaxation time of a panel in still air: heat capacity over loss, both per area, of `optodrive.device.panel`."""
HALF_PERIOD_S = 2.5e-3
"""Half a period of 200 Hz."""
MIN_PULSE_S = 1e-5
MAX_PULSE_S = 1.0
"""Limits of the search for the pulse that reaches a height."""
PULSE_FACTS = {
    "dT_peak_w020": (0.20e-3, LONG_PULSE_S),
    "T_peak_w075": (0.75e-3, LONG_PULSE_S),
    "z_peak_w020": (0.20e-3, LONG_PULSE_S),
    "z_peak_w075": (0.75e-3, LONG_PULSE_S),
    "z_tp8_w040": (0.40e-3, 8e-3),
    "F_peak_w020": (0.20e-3, LONG_PULSE_S),
    "F_peak_w055": (0.55e-3, LONG_PULSE_S),
}
"""Bridge width and pulse width of the facts read from one pulse."""


GAS_GRID_K = np.linspace(0.0, 1500.0, 6001)
"""Gas rises at which the membrane's displacement is tabulated."""


@cache
def _membrane_table_m() -> FloatArray:
    """Return the displacement of the stretched membrane at GAS_GRID_K. It depends on share × rise only."""
    volume_m3 = load_paper_facts()["V_pixel"].value
    return np.array([equilibrium_height_m(gas_k / AMBIENT_K, volume_m3) for gas_k in GAS_GRID_K])


@dataclass(frozen=True)
class CorrectedModel:
    """Parameter set with active causes."""

    base: ParameterSet
    values: CauseValues

    def compute_log_errors(self, data: Sequence[Datum]) -> FloatArray:
        """Return the logarithms of model over measured.

        For rates, they are of the height reached in the time per pixel.
        """
        return np.array([self._compute_log_error(datum) for datum in data])

    def compute_outcome(self, name: str) -> float:
        """Return a fact, SI, temperatures as rises. For an unreachable height, return the rate of the longest pulse."""
        if name in RATE_HEIGHTS_M:
            return self._rate_per_s(RATE_HEIGHTS_M[name])
        if name in PULSE_FACTS:
            return self._compute_pulse_fact(name)
        return self._compute_train_fact(name)

    def _compute_log_error(self, datum: Datum) -> float:
        if datum.id in RATE_HEIGHTS_M:
            height_m = self._rate_height_m(1.0 / datum.value)
            return log(height_m / RATE_HEIGHTS_M[datum.id])
        return log(self.compute_outcome(datum.id) / datum.value)

    @cached_property
    def _pixels(self) -> dict[tuple[float, bool], Pixel]:
        return {}

    def _build_pixel(self, width_m: float, from_table: bool = True) -> Pixel:
        """Return the pixel with scaled parameters.

        R and C are from Table S3, or from the smooth law between its rows.
        """
        key = (width_m, from_table)
        if key not in self._pixels:
            self._pixels[key] = self._scale_pixel(width_m, from_table)
        return self._pixels[key]

    def _scale_pixel(self, width_m: float, from_table: bool) -> Pixel:
        base, values = self.base, self.values
        pixel = base.build_pixel(width_m)
        if not from_table:
            pixel = pixel._replace(r_k_per_w=base.R_width_product.value / width_m, c_j_per_k=base.C_mean.value)
        return pixel._replace(
            r_k_per_w=pixel.r_k_per_w * values.get("absorber_resistance", 1.0),
            c_j_per_k=pixel.c_j_per_k * values.get("absorber_capacity", 1.0),
            epsilon=pixel.epsilon * values.get("absorbed_power", 1.0),
            tau_g_s=values.get("gas_lag", pixel.tau_g_s),
        )

    @cached_property
    def _terms(self) -> FrozenTerms:
        values = self.values
        out: dict[str, dict[str, float]] = {}
        if values.get("bridge_conductivity", 0.0) > 0.0:
            out["bridge_conductivity"] = {"exponent": values["bridge_conductivity"]}
        if values.get("radiation", 0.0) > 0.0:
            out["radiation"] = {"emitting_area": values["radiation"]}
        if values.get("wall_heating", 0.0) > 0.0:
            resistance = values["wall_heating"]
            out["wall_heating"] = {"resistance": resistance, "capacity": WALL_TAU_S / resistance}
        if values.get("panel_heating", 0.0) > 0.0:
            resistance = values["panel_heating"]
            share = self.base.epsilon.value * values.get("absorbed_power", 1.0)
            capacity = PANEL_TAU_S / resistance
            out["panel_heating"] = {"resistance": resistance, "capacity": capacity, "share": share}
        return freeze_terms(out)

    def _on_time_s(self, pulse_s: float) -> float:
        """Return the time with light per pulse."""
        return max(pulse_s - self.values.get("laser_late", 0.0), MIN_PULSE_S)

    def _train_gas_k(self, pulse_s: float) -> FloatArray:
        """Return the gas rise over a period of a steady train with equal on and off times."""
        on_s = self._on_time_s(pulse_s)
        return train_gas_k(TrainStimulus(self._build_pixel(0.55e-3), on_s, 2.0 * pulse_s - on_s), self._terms)

    def _pulse_rises_k(self, pixel: Pixel, pulse_s: float) -> tuple[float, float]:
        """Return the largest rises of absorber and gas."""
        return pulse_rises_k(PulseStimulus(pixel, self._on_time_s(pulse_s)), self._terms)

    def _displacement_m(self, gas_k: FloatArray) -> FloatArray:
        """Return the displacement for a gas that settles at half the absorber's rise."""
        values = self.values
        if "gas_membrane" in values:
            return np.interp(values["gas_membrane"] / GAS_FRACTION * gas_k, GAS_GRID_K, _membrane_table_m())
        kappa = self.base.kappa.value * values.get("membrane_plate", 1.0)
        return kappa * self._gas_share / GAS_FRACTION * gas_k

    @property
    def _gas_share(self) -> float:
        return self.values.get("gas_share", self.values.get("gas_membrane", GAS_FRACTION))

    def _force_n(self, gas_k: float) -> float:
        """Return the blocked force for a gas that settles at half the absorber's rise."""
        aperture_m2 = pi * load_paper_facts()["cavity_r"].value ** 2
        full_n: float = self.base.phi.value * self._gas_share / GAS_FRACTION * gas_k
        if "force_area" in self.values:
            return full_n * self.values["force_area"] / aperture_m2
        if "load_cell_gives" in self.values:
            # (1 + p)(1 + q p) = 1 + x: p the pressure in atmospheres, x at constant volume, q the room it makes
            q = self.values["load_cell_gives"] * ATMOSPHERE_PA / load_paper_facts()["V_pixel"].value
            x = full_n / (aperture_m2 * ATMOSPHERE_PA)
            root = sqrt((1.0 + q) ** 2 + 4.0 * q * x)
            return 2.0 * x / (1.0 + q + root) * aperture_m2 * ATMOSPHERE_PA
        return full_n

    def _compute_pulse_fact(self, name: str) -> float:
        width_m, pulse_s = PULSE_FACTS[name]
        absorber_k, gas_k = self._pulse_rises_k(self._build_pixel(width_m), pulse_s)
        if name.startswith("F_"):
            return self._force_n(gas_k)
        return float(self._displacement_m(np.array([gas_k]))[0]) if name.startswith("z_") else absorber_k

    def _rate_height_m(self, time_s: float) -> float:
        """Return the height that a pixel reaches in the time per pixel of a rate."""
        other = "rate_pixel" in self.values
        pixel = self._build_pixel(self.values.get("rate_pixel", 0.55e-3), from_table=not other)
        pixel = pixel._replace(epsilon=pixel.epsilon * self.values.get("rate_power", 1.0))
        pulse_s = max(time_s - self.values.get("dead_time", 0.0), MIN_PULSE_S)
        return float(self._displacement_m(np.array([self._pulse_rises_k(pixel, pulse_s)[1]]))[0])

    def _rate_per_s(self, height_m: float) -> float:
        low, high = log(MIN_PULSE_S), log(MAX_PULSE_S)
        while high - low > 1e-4:
            middle = 0.5 * (low + high)
            reached = self._rate_height_m(float(np.exp(middle))) >= height_m
            low, high = (low, middle) if reached else (middle, high)
        return float(np.exp(-high))

    def _compute_train_fact(self, name: str) -> float:
        pixel = self._build_pixel(0.55e-3)
        if name == "dpp_200Hz":
            return float(np.ptp(self._displacement_m(self._train_gas_k(HALF_PERIOD_S))))
        # The laws of Fig. 3D at t_p = t_g = τ. τ is that of Table S3 for all causes, as a setting of the drive.
        tau_s = self.base.build_pixel(0.55e-3).tau_s
        first_k = self._pulse_rises_k(pixel, tau_s)[1]
        heights_m = self._displacement_m(np.append(self._train_gas_k(tau_s), first_k))
        steady_m, first_m = heights_m[:-1], heights_m[-1]
        numerator_m = np.ptp(steady_m) if name == "dpp_law" else 0.5 * (steady_m[1:] + steady_m[:-1]).mean()
        return float(numerator_m / first_m)
