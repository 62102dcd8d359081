"""Predictions of the measured facts by Text S1 with some of its hypothetical errors corrected."""

from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from math import log, pi, sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.validation.facts import RATE_HEIGHTS_M, Datum
from optodrive.lab.validation.outcomes import RESPONSES, PaperModel, Peaks
from optodrive.lab.validation.stimuli import (
    AMBIENT_K,
    FULL_POWER_W,
    LONG_PULSE_S,
    FrozenTerms,
    PulseStimulus,
    TrainStimulus,
    freeze_terms,
    pulse_rises_k,
    train_gas_k,
)
from optodrive.physics.paper_facts import AMBIENT_C, load_paper_facts
from optodrive.physics.parameters import ParameterSet
from optodrive.physics.pixel import GAS_FRACTION, Pixel
from optodrive.physics.terms.mechanical import ATMOSPHERE_PA, equilibrium_height_m

CauseValues = Mapping[str, float]
"""Active causes and the parameter of each."""

WALL_TAU_S = 1.2
"""Relaxation time of the wall, as estimated in the shipped parameter set `surroundings`."""
PANEL_TAU_S = 185.0
"""Relaxation time of a panel in still air: heat capacity over loss, both per area, of `optodrive.device.panel`."""
MIN_PULSE_S = 1e-5
MAX_PULSE_S = 1.0
"""Limits of the search for the pulse that reaches a height."""
GAS_GRID_K = np.linspace(0.0, 1500.0, 6001)
"""Gas rises at which the membrane's displacement is tabulated."""


@cache
def _membrane_table_m() -> FloatArray:
    """Return the displacement of the stretched membrane at GAS_GRID_K. It depends on share × rise only."""
    volume_m3 = load_paper_facts()["V_pixel"].value
    return np.array([equilibrium_height_m(gas_k / AMBIENT_K, volume_m3) for gas_k in GAS_GRID_K])


class CorrectedModel(PaperModel):
    """Parameter set with active causes."""

    def __init__(self, base: ParameterSet, values: CauseValues) -> None:
        super().__init__(base)
        self.base, self.values = base, values
        self._build_pixel = cache(self._scale_pixel)

    def compute_log_errors(self, data: Sequence[Datum]) -> FloatArray:
        """Return the logarithms of model over measured.

        For rates, they are of the height reached in the time per pixel.
        """
        return np.array([self._compute_log_error(datum) for datum in data])

    def compute_outcome(self, name: str) -> float:
        """Return a fact, SI, temperatures as rises. For an unreachable height, return the rate of the longest pulse."""
        return RESPONSES[name](self) - (AMBIENT_C if name.startswith("T_") else 0.0)

    def _compute_log_error(self, datum: Datum) -> float:
        if datum.id in RATE_HEIGHTS_M:
            height_m = self._rate_height_m(1.0 / datum.value)
            return log(height_m / RATE_HEIGHTS_M[datum.id])
        return log(self.compute_outcome(datum.id) / datum.value)

    def _scale_pixel(self, width_m: float, from_table: bool = True) -> Pixel:
        """Return the pixel with scaled parameters.

        R and C are from Table S3, or from the smooth law between its rows.
        """
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

    def ripple_m(self, on_s: float) -> tuple[float, float]:
        """Return peak-to-peak and mean displacement of a steady train with equal pulses and pauses, m."""
        light_s = self._on_time_s(on_s)
        gas_k = train_gas_k(TrainStimulus(self._build_pixel(0.55e-3), light_s, 2.0 * on_s - light_s), self._terms)
        height_m = self._displacement_m(gas_k)
        return float(np.ptp(height_m)), float(0.5 * (height_m[1:] + height_m[:-1]).mean())

    def peaks(self, width_mm: float, pulse_s: float = LONG_PULSE_S, power_w: float = FULL_POWER_W) -> Peaks:
        """Return the peaks by a pulse on a pixel with bridges of a width."""
        pixel = self._build_pixel(width_mm * 1e-3)
        pixel = pixel._replace(epsilon=pixel.epsilon * power_w / FULL_POWER_W)
        absorber_k, gas_k = self._pulse_rises_k(pixel, pulse_s)
        return Peaks(absorber_k, gas_k, float(self._displacement_m(np.array([gas_k]))[0]), self._force_n(gas_k))

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

    def _rate_height_m(self, time_s: float) -> float:
        """Return the height that a pixel reaches in the time per pixel of a rate."""
        other = "rate_pixel" in self.values
        pixel = self._build_pixel(self.values.get("rate_pixel", 0.55e-3), from_table=not other)
        pixel = pixel._replace(epsilon=pixel.epsilon * self.values.get("rate_power", 1.0))
        pulse_s = max(time_s - self.values.get("dead_time", 0.0), MIN_PULSE_S)
        return float(self._displacement_m(np.array([self._pulse_rises_k(pixel, pulse_s)[1]]))[0])

    def rate_per_s(self, height_m: float) -> float:
        """Return the rate of pulses that reach a height."""
        low, high = log(MIN_PULSE_S), log(MAX_PULSE_S)
        while high - low > 1e-4:
            middle = 0.5 * (low + high)
            reached = self._rate_height_m(float(np.exp(middle))) >= height_m
            low, high = (low, middle) if reached else (middle, high)
        return float(np.exp(-high))
