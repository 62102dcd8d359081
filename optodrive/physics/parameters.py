"""Parameter sets: one file per set, each value with its unit, uncertainty and source."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.plausibility import PlausibleRange, guess_unit
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.core.types.arrays import FloatArray, ReadOnlyArrays
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.config_file import locate_shipped
from optodrive.device.config_sections import BridgeWidth
from optodrive.device.pixel_map import load_pixel_map
from optodrive.physics.discovered_term import KEY as DISCOVERED
from optodrive.physics.discovered_term import MAX_SLOTS, DiscoveredTerm, check_set, list_values
from optodrive.physics.pixel import Pixel
from optodrive.physics.terms import all_terms, check_requirements, find_term

FORMAT = "optodrive-parameters"
VERSION = 1


PARAMETER_UNITS = {
    "epsilon": "1",
    "tau_g": "s",
    "kappa": "m/K",
    "phi": "N/K",
    "R_width_product": "m K/W",
    "C_mean": "J/K",
    "R": "K/W",
    "C": "J/K",
}
"""Required unit of each parameter."""


class Parameter(Section):
    """One number with its unit, its standard uncertainty, if the source gives one, and its source."""

    value: float
    unit: str
    sigma: Annotated[float, Field(ge=0)] | None = None
    source: str


class NonNegativeParameter(Parameter):
    """A parameter that cannot be negative."""

    value: Annotated[float, Field(ge=0)]


def _within(low: float, high: float, unit: str) -> dict[str, PlausibleRange]:
    return {"value": PlausibleRange(low, high, unit)}


class _SiUnits(Section):
    """A model that refuses values in other units than those of `PARAMETER_UNITS`."""

    @model_validator(mode="after")
    def _check_units(self) -> Self:
        for name, unit in PARAMETER_UNITS.items():
            parameter = getattr(self, name, None)
            if parameter is None:
                continue
            if parameter.unit != unit:
                raise ValueError(f"{name} in {unit}, not in '{parameter.unit}'")
            if parameter.value == 0.0:
                raise ValueError(f"{name} greater than 0")
            if parameter.sigma is not None and parameter.sigma > parameter.value:
                likely = guess_unit(parameter.sigma, PlausibleRange(0.0, parameter.value, parameter.unit))
                hint = "" if likely is None else f"; its sigma is likely in {likely}"
                raise ValueError(f"{name} with a sigma of at most its value {parameter.value:g} {unit}{hint}")
        return self


class Bridge(_SiUnits):
    """Thermal parameters of the absorber at one bridge width, a row of Table S3."""

    width_m: BridgeWidth
    R: Annotated[NonNegativeParameter, _within(5.0, 3000.0, "K/W")]
    C: Annotated[NonNegativeParameter, _within(5e-6, 2e-3, "J/K")]


class ParameterSet(_SiUnits):
    """A named set of pixel parameters. `claims` states the stimuli and quantities for which it is valid.

    terms: parameters of the terms that extend the nominal pixel, by the keys of `optodrive.physics.terms`; discovered:
    functions that no term of the catalogue states. The limiter accounts for all of them; planner_terms: those that the
    planner simulates heights with, "discovered" for the functions.
    """

    format: Literal["optodrive-parameters"]
    version: Literal[1]
    name: str
    claims: str
    epsilon: Annotated[NonNegativeParameter, _within(0.02, 1.0, "1")]
    tau_g: Annotated[NonNegativeParameter, _within(1e-4, 0.1, "s")]
    kappa: Annotated[NonNegativeParameter, _within(1e-7, 1e-4, "m/K")]
    phi: Annotated[NonNegativeParameter, _within(1e-5, 5e-3, "N/K")]
    R_width_product: Annotated[NonNegativeParameter, _within(5e-3, 1.0, "m K/W")]
    C_mean: Annotated[NonNegativeParameter, _within(5e-6, 2e-3, "J/K")]
    bridge: tuple[Bridge, ...]
    terms: dict[str, dict[str, Parameter]] = Field(default_factory=dict)
    discovered: Annotated[tuple[DiscoveredTerm, ...], Field(max_length=MAX_SLOTS)] = ()
    planner_terms: tuple[str, ...] = ()

    @property
    def term_keys(self) -> tuple[str, ...]:
        """Keys of all terms, with that of discovered functions."""
        return (*self.terms, *((DISCOVERED,) if self.discovered else ()))

    def term_values(self, key: str) -> dict[str, float]:
        """Return a term's parameters by name, SI."""
        if key == DISCOVERED:
            return list_values(self.discovered)
        return {name: item.value for name, item in self.terms[key].items()}

    def build_pixel(self, bridge_width_m: float) -> Pixel:
        """Return the pixel of a bridge width: its row of Table S3, else R = a / w and the mean C."""
        # A width that was measured takes its own R and C, others R ∝ 1/w and the mean C.
        row = next((b for b in self.bridge if abs(b.width_m - bridge_width_m) < 1e-6), None)
        return Pixel(
            r_k_per_w=row.R.value if row else self.R_width_product.value / bridge_width_m,
            c_j_per_k=row.C.value if row else self.C_mean.value,
            epsilon=self.epsilon.value,
            tau_g_s=self.tau_g.value,
            kappa_m_per_k=self.kappa.value,
            phi_n_per_k=self.phi.value,
        )


@dataclass(frozen=True, eq=False)
class PixelArray(ReadOnlyArrays):
    """Nominal parameters of every pixel of a display, each [p], with names and units as in `Pixel`."""

    r_k_per_w: FloatArray
    c_j_per_k: FloatArray
    epsilon: FloatArray
    tau_g_s: FloatArray
    kappa_m_per_k: FloatArray
    phi_n_per_k: FloatArray

    def __len__(self) -> int:
        return len(self.r_k_per_w)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the columns only: `elements` would take longer than the rest of a display's state."""
        return PixelArray, tuple(getattr(self, name) for name in self.__dataclass_fields__)

    @classmethod
    def uniform(cls, pixel: Pixel, count: int) -> "PixelArray":
        """Return `count` equal pixels."""
        return cls(*(np.full(count, getattr(pixel, name)) for name in cls.__dataclass_fields__))

    @cached_property
    def elements(self) -> tuple[Pixel, ...]:
        """Parameters pixel by pixel, [p] of `Pixel`."""
        columns = (getattr(self, name).tolist() for name in self.__dataclass_fields__)
        return tuple(Pixel(*row) for row in zip(*columns, strict=True))


def load_parameters(name: str | Path) -> ParameterSet:
    """Load a parameter set by its shipped name or from a file. Raise InputError for invalid content."""
    path = Path(name)
    if path.suffix != ".toml":
        known = sorted(p.stem for p in locate_shipped("parameters").glob("*.toml"))
        if str(name) not in known:
            raise InputError("pixel_model.parameters", str(name), "a .toml file, or " + ", ".join(known))
        path = locate_shipped("parameters", f"{name}.toml")
    table = _merge_base(path, read_toml(path))
    parameters = parse_table(path, table, ParameterSet)
    terms = {key: _complete_term(f"{path}: terms.{key}", key, values) for key, values in parameters.terms.items()}
    parameters = parameters.model_copy(update={"terms": terms})
    check_requirements(f"{path}: terms", parameters.terms)
    c_min_j_per_k = min(parameters.C_mean.value, *(row.C.value for row in parameters.bridge), inf)
    check_set(parameters.discovered, f"{path}: discovered", c_min_j_per_k)
    if parameters.discovered and DISCOVERED not in parameters.planner_terms:
        expected = f"'{DISCOVERED}' among them: only what is simulated is kept within the range of its data"
        raise InputError(f"{path}: planner_terms", list(parameters.planner_terms), expected)
    for key in parameters.planner_terms:
        if key not in parameters.term_keys:
            raise InputError(
                f"{path}: planner_terms", key, f"a term of this set, {suggest_nearest(key, [*parameters.term_keys])}"
            )
        if not all_terms()[key].in_pixel:
            raise InputError(f"{path}: planner_terms", key, "a term that heights can be planned with")
    return parameters


def list_own_terms(path: Path) -> tuple[str, ...]:
    """Return the keys of the terms that a parameter file states itself, rather than its base."""
    table = read_toml(path)
    terms = table.get("terms", {})
    own = tuple(terms) if isinstance(terms, dict) else ()
    return (*own, DISCOVERED) if table.get("discovered") else own


def _complete_term(where: str, key: str, values: dict[str, Parameter]) -> dict[str, Parameter]:
    """Return all parameters of a term, those that are omitted by their defaults.

    Raises InputError unless the term is known and has only its parameters, in unit and plausible range.
    """
    completed = {}
    for item in find_term(where, key, values).parameters:
        if item.name not in values and item.if_omitted is not None:
            completed[item.name] = Parameter(value=item.if_omitted, unit=item.unit, source="the default where omitted")
            continue
        given = completed[item.name] = values[item.name]
        if given.unit != item.unit:
            raise InputError(f"{where}.{item.name}.unit", given.unit, f"'{item.unit}'")
        if not item.low <= given.value <= item.high:
            sizes = PlausibleRange(max(item.low, 0.0), max(abs(item.low), item.high), item.unit)
            unit = guess_unit(given.value, sizes)
            likely = "" if unit is None else f"; this value is likely in {unit}"
            expected = f"{item.low:g} to {item.high:g} {item.unit}{likely}"
            raise InputError(f"{where}.{item.name}.value", given.value, expected)
    return completed


def _merge_base(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    """Return the table merged over the set that it names as its base. Terms are merged by key."""
    check_format(path, table, FORMAT, VERSION)
    base = table.pop("base", None)
    if base is None:
        return table
    shipped = {item.stem: item for item in locate_shipped("parameters").glob("*.toml")}
    if not isinstance(base, str) or base not in shipped:
        raise InputError(f"{path}: base", base, "the name of a shipped parameter set, " + ", ".join(sorted(shipped)))
    base_table = _merge_base(shipped[base], read_toml(shipped[base]))
    terms = table.get("terms", {})
    if isinstance(terms, dict):  # else the schema refuses it
        # By key: a set that states one term keeps the other terms of its base, whole.
        terms = {**base_table.get("terms", {}), **terms}
    return {**base_table, **table, "terms": terms}


def build_display_pixels(config: Config, parameters: ParameterSet) -> PixelArray:
    """Return the parameters of every pixel of a configured display. The pixel map's gains scale κ alone.

    Raises InputError as `load_pixel_map`, and for gains relative to another parameter set.
    """
    pixel, pixel_map = parameters.build_pixel(config.display.bridge_width_m), load_pixel_map(config)
    pixels = PixelArray.uniform(pixel, len(build_pixel_layout(config.display)))
    if pixel_map is None:
        return pixels
    if pixel_map.model not in ("", parameters.name):
        expected = f"'{parameters.name}', the set that heights are planned with: calibrate again from the recordings"
        raise InputError(f"{config.display.pixel_map}: model.parameters", pixel_map.model, expected)
    # κ alone: one factor then reaches, predicts and reports the height, and changes no heat.
    return replace(pixels, kappa_m_per_k=pixels.kappa_m_per_k * pixel_map.displacement_factor)
