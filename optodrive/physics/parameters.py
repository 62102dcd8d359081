"""Parameter sets: one file a source, each value with its unit, uncertainty and source."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.files import read_toml
from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.device.config import Config, build_input_error, build_pixel_layout, check_format, locate_shipped
from optodrive.device.pixel_map import load_pixel_map
from optodrive.physics.pixel import Pixel
from optodrive.physics.terms import check_requirements, discover_terms, find_term

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
"""The unit each parameter's value must be in."""


class Parameter(BaseModel):
    """One number: value, unit, standard uncertainty (absent where the source gives none) and source."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    value: float
    unit: str
    sigma: Annotated[float, Field(ge=0)] | None = None
    source: str


class NonNegativeParameter(Parameter):
    """A number that cannot be negative."""

    value: Annotated[float, Field(ge=0)]


class _SiUnits(BaseModel):
    # A value in another unit would be read as SI without a word.
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
        return self


class Bridge(_SiUnits):
    """Thermal parameters of the absorber at one bridge width (a row of Table S3)."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    width_m: Annotated[float, Field(gt=0)]
    R: NonNegativeParameter
    C: NonNegativeParameter


class ParameterSet(_SiUnits):
    """A named set of pixel parameters; `claims` says what it stands for and what it does not.

    terms: what is added to the nominal pixel, by the keys of `optodrive.physics.terms`, and each term's parameters.
    The limiter counts with all of them; planner_terms: those that heights are planned with.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    format: Literal["optodrive-parameters"]
    version: Literal[1]
    name: str
    claims: str
    epsilon: NonNegativeParameter
    tau_g: NonNegativeParameter
    kappa: NonNegativeParameter
    phi: NonNegativeParameter
    R_width_product: NonNegativeParameter
    C_mean: NonNegativeParameter
    bridge: tuple[Bridge, ...]
    terms: dict[str, dict[str, Parameter]] = {}
    planner_terms: tuple[str, ...] = ()

    def term_values(self, key: str) -> dict[str, float]:
        """A term's parameters, SI, by name."""
        return {name: item.value for name, item in self.terms[key].items()}

    def build_pixel(self, bridge_width_m: float) -> Pixel:
        """The pixel of a bridge width: its row of Table S3, or R = a / w and the mean C between rows."""
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
class PixelArray:
    """The nominal parameters of every pixel of a display, each [p]; names and units as in `Pixel`."""

    r_k_per_w: FloatArray
    c_j_per_k: FloatArray
    epsilon: FloatArray
    tau_g_s: FloatArray
    kappa_m_per_k: FloatArray
    phi_n_per_k: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.r_k_per_w)

    @classmethod
    def uniform(cls, pixel: Pixel, count: int) -> "PixelArray":
        """The same pixel `count` times."""
        return cls(*(np.full(count, getattr(pixel, name)) for name in cls.__dataclass_fields__))

    @cached_property
    def elements(self) -> tuple[Pixel, ...]:
        """The parameters pixel by pixel: [p] of `Pixel`."""
        columns = (getattr(self, name).tolist() for name in self.__dataclass_fields__)
        return tuple(Pixel(*row) for row in zip(*columns, strict=True))


def load_parameters(name: str | Path) -> ParameterSet:
    """A parameter set by its shipped name or from a file; raises InputError with one line."""
    path = Path(name)
    if path.suffix != ".toml":
        known = sorted(p.stem for p in locate_shipped("parameters").glob("*.toml"))
        if str(name) not in known:
            raise InputError("pixel_model.parameters", str(name), "a .toml file, or " + ", ".join(known))
        path = locate_shipped("parameters", f"{name}.toml")
    table = _merge_base(path, read_toml(path))
    try:
        parameters = ParameterSet.model_validate(table)
    except ValidationError as error:
        raise build_input_error(error, str(path), ParameterSet) from None
    for key, values in parameters.terms.items():
        _check_term(f"{path}: terms.{key}", key, values)
    check_requirements(f"{path}: terms", parameters.terms)
    for key in parameters.planner_terms:
        if key not in parameters.terms:
            raise InputError(
                f"{path}: planner_terms", key, f"a term of this set, {suggest_nearest(key, [*parameters.terms])}"
            )
        if not discover_terms()[key].in_pixel:
            raise InputError(f"{path}: planner_terms", key, "a term that heights can be planned with")
    return parameters


def _check_term(where: str, key: str, values: dict[str, Parameter]) -> None:
    """A term must be known and have each of its parameters, in its unit and plausible range, and no other."""
    for item in find_term(where, key, values).parameters:
        given = values[item.name]
        if given.unit != item.unit:
            raise InputError(f"{where}.{item.name}.unit", given.unit, f"'{item.unit}'")
        if not item.low <= given.value <= item.high:
            raise InputError(f"{where}.{item.name}.value", given.value, f"{item.low:g} to {item.high:g} {item.unit}")


def _merge_base(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    """A set that names a base is the base with the set's own entries over it, its terms beside the base's."""
    check_format(path, table, FORMAT, VERSION)
    base = table.pop("base", None)
    if base is None:
        return table
    below = locate_shipped("parameters", f"{base}.toml")
    if not below.is_file():
        raise InputError(f"{path}: base", base, "the name of a shipped parameter set")
    under = _merge_base(below, read_toml(below))
    terms = {**under.get("terms", {}), **table.get("terms", {})}
    return {**under, **table, "terms": terms}


def build_display_pixels(config: Config, parameters: ParameterSet) -> PixelArray:
    """The parameters of every pixel of a configured display; its map's gains lift membranes, never the heat.

    Raises InputError as `map_of`, or for gains that are against another parameter set.
    """
    pixel, known = parameters.build_pixel(config.display.bridge_width_m), load_pixel_map(config)
    pixels = PixelArray.uniform(pixel, len(build_pixel_layout(config.display)))
    if known is None:
        return pixels
    if known.model not in ("", parameters.name):
        expected = f"'{parameters.name}', the one planned with: calibrate again from the recordings"
        raise InputError(f"{config.display.pixel_map}: model.parameters", known.model, expected)
    return replace(pixels, kappa_m_per_k=pixels.kappa_m_per_k * known.displacement_factor)
