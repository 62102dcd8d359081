"""Configuration: one TOML file a display, versioned, checked whole before anything uses it."""

import tomllib
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from optodrive.errors import InputError, nearest
from optodrive.flow import FloatArray, IntArray, freeze_arrays

FORMAT = "optodrive-config"
VERSION = 3
DEFAULT_CONFIG = "display-437"
WIRE_ON_MAX_S = 65_535e-6
"""Longest gate-on time one point of the wire protocol can carry (16 bit, microseconds)."""

CODES_A_SIDE = 32_767
"""Steps of the converter from the middle to the end of a mirror's range."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
HalfWidth = Annotated[float, Field(ge=0, le=0.5)]


class Section(BaseModel):
    """A part of the configuration: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class DisplaySection(Section):
    """The lattice of pixels: rows × columns at one pitch, centred on the optical axis, less the missing places."""

    rows: Annotated[int, Field(ge=1, le=200)]
    columns: Annotated[int, Field(ge=1, le=200)]
    pitch_m: Positive
    missing: tuple[tuple[int, int], ...] = ()
    bridge_width_m: Positive
    absorber_width_m: Positive = 2.0e-3
    absorber_height_m: Positive = 1.5e-3

    @model_validator(mode="after")
    def _missing_places_exist(self) -> Self:
        for row, column in self.missing:
            if not (0 <= row < self.rows and 0 <= column < self.columns):
                raise ValueError(
                    f"missing place ({row}, {column}) lies outside {self.rows} rows × {self.columns} columns"
                )
        if len(set(self.missing)) != len(self.missing):
            raise ValueError("a missing place is named twice")
        if len(self.missing) >= self.rows * self.columns:
            raise ValueError("every place is missing")
        return self


class PixelModelSection(Section):
    """Which parameter set of configs/parameters the pixels follow."""

    parameters: str = "calibrated"


class LaserSection(Section):
    """The diode: incident power at the sample with the gate fully on, its modulation, its focus on the absorber."""

    max_power_w: Positive
    pwm_hz: Positive
    focus_width_m: Positive
    focus_height_m: Positive


class ScannerSection(Section):
    """Mirrors and lens: ideal f-theta x = f · 2 · angle; either mirror follows its command as a servo.

    delay_s after a command the servo's own target begins to move towards it at slew_rad_per_s; the angle follows that
    with natural frequency bandwidth_hz and damping, always underdamped. aim_error_m: how far a settled beam may stand
    from where it should.
    """

    focal_length_m: Positive
    range_rad: Annotated[float, Field(gt=0, lt=0.8)]
    bandwidth_hz: Annotated[float, Field(ge=100, le=100_000)]
    damping: Annotated[float, Field(ge=0.3, le=0.9)]
    delay_s: Annotated[float, Field(ge=0, le=0.01)]
    slew_rad_per_s: Annotated[float, Field(ge=1, le=100_000)]
    aim_error_m: NonNegative

    @property
    def code_rad(self) -> float:
        """Mirror angle of one step of the converter, rad: range_rad is the most it can say."""
        return self.range_rad / CODES_A_SIDE


class UncertaintySection(Section):
    """Declared half-widths of the model's parameters, relative; exponent: absolute. The limiter counts them in full."""

    absorbed_power: HalfWidth = 0.03
    bridge_resistance: HalfWidth = 0.02
    absorber_capacity: HalfWidth = 0.05
    exponent: Annotated[float, Field(ge=0, le=0.5)] = 0.02
    gas_lag: HalfWidth = 0.25
    wall_resistance: HalfWidth = 0.02
    wall_capacity: HalfWidth = 0.1
    side_resistance: HalfWidth = 0.1
    touch_share: HalfWidth = 0.02
    touch_lag: HalfWidth = 0.1


class LimitsSection(Section):
    """Caps that no sequence of plans passes.

    absorber_max_c, wall_max_c, touch_max_c: temperatures anywhere on the display, wall and touch surface as far as
    the parameter set has them. galvo_acceleration_rms_max_rad_per_s2: of either mirror, mean over galvo_mean_s.
    pulse_energy_max_j caps a pulse, and what several pulses leave in a pixel's bucket, which leaks at
    pixel_mean_power_max_w. Pulses on a pixel closer than pulse_rest_min_s count as one against pulse_width_max_s.
    """

    absorber_max_c: float
    wall_max_c: float
    touch_max_c: float
    galvo_acceleration_rms_max_rad_per_s2: Positive
    galvo_mean_s: Annotated[float, Field(ge=0.05, allow_inf_nan=False)]
    pulse_energy_max_j: Positive
    pulse_width_max_s: Annotated[float, Field(gt=0, le=WIRE_ON_MAX_S)]
    pulse_rest_min_s: Annotated[float, Field(gt=0, le=0.01)] = 5e-4
    pixel_mean_power_max_w: Positive
    pixel_mean_window_s: Positive
    display_mean_power_max_w: Positive
    display_mean_window_s: Positive
    uncertainty: UncertaintySection = UncertaintySection()


class BoardSection(Section):
    """How the board is reached; uid: refuse any other board; port: serial device, or the simulated board's link."""

    transport: Literal["simulated", "serial"]
    port: str = ""
    baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 1_000_000
    uid: str = ""
    lease_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.1

    @model_validator(mode="after")
    def _serial_has_a_port(self) -> Self:
        if self.transport == "serial" and not self.port:
            raise ValueError("transport 'serial' needs port, for example \"/dev/ttyACM0\"")
        return self


class DaemonSection(Section):
    """The daemon's address; hosts: names it answers to besides loopback; body_max_bytes: largest request body."""

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65_535)] = 8450
    hosts: tuple[str, ...] = ()
    body_max_bytes: Annotated[int, Field(ge=1024, le=64_000_000)] = 8_000_000


class Config(Section):
    """The whole configuration of one display."""

    format: Literal["optodrive-config"]
    version: Literal[3]
    name: str
    ambient_c: Annotated[float, Field(ge=-20, le=60)]
    display: DisplaySection
    pixel_model: PixelModelSection = PixelModelSection()
    laser: LaserSection
    scanner: ScannerSection
    limits: LimitsSection
    board: BoardSection
    daemon: DaemonSection = DaemonSection()

    @model_validator(mode="after")
    def _limits_do_not_cross(self) -> Self:
        limits, laser = self.limits, self.laser
        for key in ("absorber_max_c", "wall_max_c", "touch_max_c"):
            if getattr(limits, key) <= self.ambient_c:
                raise ValueError(f"limits.{key} {getattr(limits, key)} must lie above ambient_c {self.ambient_c}")
        if limits.wall_max_c > limits.absorber_max_c:
            raise ValueError(
                f"limits.wall_max_c {limits.wall_max_c} must not exceed limits.absorber_max_c {limits.absorber_max_c}"
            )
        if limits.pulse_width_max_s < 1.0 / laser.pwm_hz:
            raise ValueError(
                f"limits.pulse_width_max_s {limits.pulse_width_max_s} must hold one PWM period, {1 / laser.pwm_hz}"
            )
        if limits.pixel_mean_power_max_w > limits.display_mean_power_max_w:
            raise ValueError(
                f"limits.pixel_mean_power_max_w {limits.pixel_mean_power_max_w} must not exceed "
                f"limits.display_mean_power_max_w {limits.display_mean_power_max_w}"
            )
        for key in ("pixel_mean_window_s", "display_mean_window_s"):
            if getattr(limits, key) < limits.pulse_width_max_s:
                raise ValueError(
                    f"limits.{key} {getattr(limits, key)} must hold pulse_width_max_s {limits.pulse_width_max_s}"
                )
        return self

    @model_validator(mode="after")
    def _field_reaches_the_display(self) -> Self:
        layout = pixel_layout(self.display)
        reach_m = 2.0 * self.scanner.range_rad * self.scanner.focal_length_m
        farthest_m = float(max(np.abs(layout.x_m).max(), np.abs(layout.y_m).max()))
        if farthest_m > reach_m:
            raise ValueError(
                f"scanner reaches ±{reach_m:.4f} m (range_rad, focal_length_m), a pixel lies at {farthest_m:.4f} m"
            )
        return self

    @model_validator(mode="after")
    def _focus_fits_on_the_absorber(self) -> Self:
        display, laser = self.display, self.laser
        least_rad = 2.0 * self.scanner.code_rad
        for side, tolerance_rad in zip(("width", "height"), self.tolerance_rad, strict=True):
            if tolerance_rad <= least_rad:
                raise ValueError(
                    f"laser.focus_{side}_m {getattr(laser, f'focus_{side}_m')} with scanner.aim_error_m "
                    f"{self.scanner.aim_error_m} to either side does not fit on display.absorber_{side}_m "
                    f"{getattr(display, f'absorber_{side}_m')} with two steps of the converter to spare"
                )
        return self

    @property
    def tolerance_rad(self) -> tuple[float, float]:
        """How far mirrors x and y may stand from where they should with the whole focus on the absorber, rad."""
        display, laser, scanner = self.display, self.laser, self.scanner
        room_m = (
            (display.absorber_width_m - laser.focus_width_m) / 2.0 - scanner.aim_error_m,
            (display.absorber_height_m - laser.focus_height_m) / 2.0 - scanner.aim_error_m,
        )
        return room_m[0] / (2.0 * scanner.focal_length_m), room_m[1] / (2.0 * scanner.focal_length_m)


@dataclass(frozen=True, eq=False)
class PixelLayout:
    """Where pixels lie, on the optical axis' origin, x to the right, y up; index by rows from the bottom. All [p]."""

    x_m: FloatArray
    y_m: FloatArray
    row: IntArray
    column: IntArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.x_m)


def pixel_layout(display: DisplaySection) -> PixelLayout:
    """Pixel positions of a lattice; missing places take no index."""
    missing = set(display.missing)
    places = [
        (row, column)
        for row in range(display.rows)
        for column in range(display.columns)
        if (row, column) not in missing
    ]
    row, column = np.array(places, dtype=np.int64).T
    return PixelLayout(
        x_m=(column - (display.columns - 1) / 2) * display.pitch_m,
        y_m=(row - (display.rows - 1) / 2) * display.pitch_m,
        row=row.copy(),
        column=column.copy(),
    )


def shipped_path(*parts: str) -> Path:
    """A file that ships with the package: from the wheel, or from the source tree beside the package."""
    package = Path(str(files("optodrive")))
    installed = package / "_shipped" / "configs"
    return (installed if installed.is_dir() else package.parent / "configs").joinpath(*parts)


def shipped_configs() -> list[str]:
    """Names of the configurations that ship with the package."""
    return sorted(path.stem for path in shipped_path().glob("display-*.toml"))


def load_config(source: str | Path | None = None) -> Config:
    """Read a configuration file, or a shipped one by its name; raises InputError with one line."""
    source = DEFAULT_CONFIG if source is None else source
    path = Path(source)
    if not path.exists():
        if str(source) not in shipped_configs():
            raise InputError("--config", str(source), "a file, or " + ", ".join(shipped_configs()))
        path = shipped_path(f"{source}.toml")
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    try:
        return Config.model_validate(table)
    except ValidationError as error:
        raise input_error(error, str(path), Config) from None


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as a table; raises InputError where it cannot be read or parsed."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(str(path), str(error), "valid TOML") from None


def check_format(path: Path, table: dict[str, Any], expected: str, version: int) -> None:
    """Refuse a file of another format or version by name, rather than misread it."""
    if table.get("format") != expected:
        raise InputError(f"{path}: format", table.get("format"), f"'{expected}'")
    if table.get("version") != version:
        raise InputError(f"{path}: version", table.get("version"), f"{version}, the one this release reads")


def input_error(error: ValidationError, where: str, model: type[BaseModel] | None = None) -> InputError:
    """The first of pydantic's complaints as one line; an unknown key comes with the nearest known one."""
    complaints = error.errors(include_url=False)
    first = next((item for item in complaints if item["type"] == "extra_forbidden"), complaints[0])
    place = ".".join(str(part) for part in first["loc"])
    label = f"{where}: {place}" if place else where
    if first["type"] == "extra_forbidden":
        known = _known_keys(model, first["loc"][:-1]) if model else []
        expected = f"a known key, {nearest(str(first['loc'][-1]), known)}" if known else "no such key"
        return InputError(label, str(first["loc"][-1]), expected, code="unknown_key")
    message = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    if first["type"] == "missing":
        return InputError(label, None, "this key to be there")
    if first["type"] == "value_error":
        return InputError(label, "values that contradict", message)
    return InputError(label, first["input"], message)


def _known_keys(model: type[BaseModel], path: tuple[str | int, ...]) -> list[str]:
    for part in path:
        item = model.model_fields.get(str(part))
        if item is None or not (isinstance(item.annotation, type) and issubclass(item.annotation, BaseModel)):
            return []
        model = item.annotation
    return list(model.model_fields)
