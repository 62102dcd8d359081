"""Configuration: one TOML file a display, versioned, checked whole before anything uses it."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.files import read_toml
from optodrive.core.types.arrays import FloatArray, IntArray, freeze_arrays

FORMAT = "optodrive-config"
VERSION = 3
MIRRORS_FORMAT = "optodrive-mirrors"
MIRRORS_VERSION = 1
DEFAULT_CONFIG = "display-437"
WIRE_ON_MAX_S = 65_535e-6
"""Longest gate-on time one point of the wire protocol can carry (16 bit, microseconds)."""

HALF_RANGE_CODES = 32_767
"""Steps of the board's converter from the middle to the end of a mirror's range."""
HELIOS_HALF_RANGE_CODES = 2_047
"""The same of a Helios, whose converter has 12 bits."""
POWER_STEPS = 65_535
"""Steps of the board's duty from none to the laser's full power."""
HELIOS_POWER_STEPS = 255
HELIOS_TIMING_SLACK_POINTS = 5
"""Light on a Helios begins up to two points late (rounding; the end of a frame) and ends up to three early (the same,
and the dark point before a pulse that follows at once)."""
HELIOS_POINT_EXCESS_S = 1e-8
"""A point lasts up to a tick of the board's clock longer than asked for."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
HalfWidth = Annotated[float, Field(ge=0, le=0.5)]
UsbId = Annotated[int, Field(ge=0, le=0xFFFF)]


class Section(BaseModel):
    """A part of the configuration: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class DisplaySection(Section):
    """The lattice of pixels: rows × columns at one pitch, centred on the optical axis, less the missing places.

    pixel_map: file of what was measured of each pixel, from the configuration's folder.
    """

    rows: Annotated[int, Field(ge=1, le=200)]
    columns: Annotated[int, Field(ge=1, le=200)]
    pitch_m: Positive
    missing: tuple[tuple[int, int], ...] = ()
    bridge_width_m: Positive
    absorber_width_m: Positive = 2.0e-3
    absorber_height_m: Positive = 1.5e-3
    pixel_map: Annotated[str, Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _check_missing_places(self) -> Self:
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


class ServoSection(Section):
    """How either mirror follows its command.

    delay_s after a command the servo's own target begins to move towards it at slew_rad_per_s; the angle follows that
    with natural frequency bandwidth_hz and damping, always underdamped.
    """

    bandwidth_hz: Annotated[float, Field(ge=100, le=100_000)]
    damping: Annotated[float, Field(ge=0.3, le=0.9)]
    delay_s: Annotated[float, Field(ge=0, le=0.01)]
    slew_rad_per_s: Annotated[float, Field(ge=1, le=100_000)]


class ScannerSection(ServoSection):
    """Mirrors and lens: ideal f-theta x = f · 2 · angle; either mirror follows its command as a servo.

    aim_error_m: how far a settled beam may stand from where it should. field: file of a calibrated field in place of
    the ideal lens, from the configuration's folder; mirrors: the same of measured servos, which go before those stated.
    half_range_codes: steps of the converter from the middle to the end of the range.
    """

    focal_length_m: Positive
    range_rad: Annotated[float, Field(gt=0, lt=0.8)]
    aim_error_m: NonNegative
    field: Annotated[str, Field(min_length=1)] | None = None
    mirrors: Annotated[str, Field(min_length=1)] | None = None
    half_range_codes: int = HALF_RANGE_CODES

    @property
    def rad_per_code(self) -> float:
        """Mirror angle of one step of the converter, rad: range_rad is the most it can say."""
        return self.range_rad / self.half_range_codes


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
    pixel_mean_power_max_w. Pulses on a pixel closer than pulse_gap_min_s count as one against pulse_width_max_s.
    """

    absorber_max_c: float
    wall_max_c: float
    touch_max_c: float
    galvo_acceleration_rms_max_rad_per_s2: Positive
    galvo_mean_s: Annotated[float, Field(ge=0.05, allow_inf_nan=False)]
    pulse_energy_max_j: Positive
    pulse_width_max_s: Annotated[float, Field(gt=0, le=WIRE_ON_MAX_S)]
    pulse_gap_min_s: Annotated[float, Field(gt=0, le=0.01)] = 5e-4
    pixel_mean_power_max_w: Positive
    pixel_mean_window_s: Positive
    display_mean_power_max_w: Positive
    display_mean_window_s: Positive
    uncertainty: UncertaintySection = UncertaintySection()


class BoardSection(Section):
    """How the board is reached; uid: refuse any other board; port: serial device, or the simulated board's link.

    vendor_id, product_id, serial_number: a board on USB; without a serial number it must be the only one of its kind.
    points_per_s, interlock_watched: for a Helios, whose uid is its name; whether an external interlock cuts its light.
    """

    transport: Literal["simulated", "serial", "usb", "helios"]
    port: str = ""
    baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 1_000_000
    uid: str = ""
    lease_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.1
    vendor_id: UsbId | None = None
    product_id: UsbId | None = None
    serial_number: str = ""
    points_per_s: Annotated[int, Field(ge=20_000, le=50_000)] = 40_000
    interlock_watched: bool = False

    @model_validator(mode="after")
    def _check_address(self) -> Self:
        if self.transport == "serial" and not self.port:
            raise ValueError("transport 'serial' needs port, for example \"/dev/ttyACM0\"")
        if self.transport == "usb" and (self.vendor_id is None or self.product_id is None):
            raise ValueError("transport 'usb' needs vendor_id and product_id, for example 0x1209 and 0x0001")
        return self

    @property
    def timing_slack_s(self) -> float:
        """By how much two times of a plan may come nearer to each other on this board, s; a tick is none."""
        point_s = 1.0 / self.points_per_s + HELIOS_POINT_EXCESS_S
        return HELIOS_TIMING_SLACK_POINTS * point_s if self.transport == "helios" else 0.0


class SensorSection(Section):
    """A spot sensor on a serial port of its own, as SENSOR.md says; a simulated board brings one."""

    port: Annotated[str, Field(min_length=1)]
    baud: Annotated[int, Field(ge=1200, le=12_000_000)] = 115_200


class DaemonSection(Section):
    """The daemon's address; hosts: names it answers to besides loopback; body_max_bytes: largest request body.

    socket: a Unix socket it listens at too. tokens: file of its tokens, kept over restarts; without one they are made
    anew at each start. audit: file to which it adds who armed, stopped, pushed. requests_per_s, requests_burst: what a
    caller may ask for, for ever and at once; STOP is not counted. record: a folder in which each session is recorded.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65_535)] = 8450
    socket: str = ""
    hosts: tuple[str, ...] = ()
    body_max_bytes: Annotated[int, Field(ge=1024, le=64_000_000)] = 8_000_000
    tokens: str = ""
    audit: str = ""
    requests_per_s: Annotated[float, Field(ge=1, le=100_000)] = 500.0
    requests_burst: Annotated[int, Field(ge=1, le=100_000)] = 1000
    record: str = ""


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
    sensor: SensorSection | None = None
    daemon: DaemonSection = DaemonSection()

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
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
    def _check_scan_range(self) -> Self:
        layout = build_pixel_layout(self.display)
        reach_m = 2.0 * self.scanner.range_rad * self.scanner.focal_length_m
        farthest_m = float(max(np.abs(layout.x_m).max(), np.abs(layout.y_m).max()))
        if farthest_m > reach_m:
            raise ValueError(
                f"scanner reaches ±{reach_m:.4f} m (range_rad, focal_length_m), a pixel lies at {farthest_m:.4f} m"
            )
        return self

    @model_validator(mode="after")
    def _check_focus(self) -> Self:
        display, laser = self.display, self.laser
        least_rad = 2.0 * self.scanner.rad_per_code
        for side, tolerance_rad in zip(("width", "height"), self.tolerance_rad, strict=True):
            if tolerance_rad <= least_rad:
                raise ValueError(
                    f"laser.focus_{side}_m {getattr(laser, f'focus_{side}_m')} with scanner.aim_error_m "
                    f"{self.scanner.aim_error_m} to either side does not fit on display.absorber_{side}_m "
                    f"{getattr(display, f'absorber_{side}_m')} with two steps of the converter to spare"
                )
        return self

    @model_validator(mode="after")
    def _check_converter_codes(self) -> Self:
        steps = HELIOS_HALF_RANGE_CODES if self.board.transport == "helios" else HALF_RANGE_CODES
        if self.scanner.half_range_codes != steps:
            raise ValueError(
                f"scanner.half_range_codes {self.scanner.half_range_codes} must be {steps}, "
                f"the converter's steps behind board.transport '{self.board.transport}'"
            )
        return self

    @property
    def min_power_w(self) -> float:
        """The laser power that the board's smallest step stands for, W; it rounds down."""
        steps = HELIOS_POWER_STEPS if self.board.transport == "helios" else POWER_STEPS
        return self.laser.max_power_w / steps

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


def build_pixel_layout(display: DisplaySection) -> PixelLayout:
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


def locate_shipped(*parts: str) -> Path:
    """A file that ships with the package: from the wheel, or from the source tree beside the package."""
    package = Path(str(files("optodrive")))
    installed = package / "_shipped" / "configs"
    return (installed if installed.is_dir() else package.parent / "configs").joinpath(*parts)


def list_shipped_configs() -> list[str]:
    """Names of the configurations that ship with the package."""
    return sorted(path.stem for path in locate_shipped().glob("display-*.toml"))


def load_config(source: str | Path | None = None, measured_servo: bool = True) -> Config:
    """Read a configuration file, or a shipped one by its name; raises InputError with one line.

    measured: with the mirrors' file it names, else with the servo it states.
    """
    source = DEFAULT_CONFIG if source is None else source
    path = Path(source)
    if not path.exists():
        if str(source) not in list_shipped_configs():
            raise InputError("--config", str(source), "a file, or " + ", ".join(list_shipped_configs()))
        path = locate_shipped(f"{source}.toml")
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    _resolve_paths(path, table.get("scanner"), ("field", "mirrors"))
    _resolve_paths(path, table.get("display"), ("pixel_map",))
    try:
        config = Config.model_validate(table)
    except ValidationError as error:
        raise build_input_error(error, str(path), Config) from None
    mirrors = config.scanner.mirrors
    return apply_measured_servo(config, Path(mirrors)) if measured_servo and mirrors is not None else config


def _resolve_paths(path: Path, section: object, keys: tuple[str, ...]) -> None:
    """Files that a section names are looked for from the configuration's folder."""
    for key in keys:
        if isinstance(section, dict) and isinstance(section.get(key), str) and section[key]:
            section[key] = str(path.parent / section[key])


class GalvoSection(Section):
    """share: of the galvo cap that is left, where a mirror accelerates more than the one servo that is counted."""

    share: Annotated[float, Field(gt=0, le=1)] = 1.0


class MirrorsFile(Section):
    """mirrors.toml, as `optodrive calibrate servo` writes it; about and axes are for people."""

    format: Literal["optodrive-mirrors"]
    version: Literal[1]
    scanner: ServoSection
    galvo: GalvoSection = GalvoSection()
    about: dict[str, Any] = {}
    axes: dict[str, Any] = {}


def apply_measured_servo(config: Config, path: Path) -> Config:
    """The configuration with measured servos, and the galvo cap that they leave; InputError with one line."""
    table = read_toml(path)
    check_format(path, table, MIRRORS_FORMAT, MIRRORS_VERSION)
    try:
        measured = MirrorsFile.model_validate(table)
    except ValidationError as error:
        raise build_input_error(error, str(path), MirrorsFile) from None
    scanner = config.scanner.model_copy(update={**measured.scanner.model_dump(), "mirrors": str(path)})
    stated = config.limits.galvo_acceleration_rms_max_rad_per_s2
    cap = {"galvo_acceleration_rms_max_rad_per_s2": stated * measured.galvo.share}
    return config.model_copy(update={"scanner": scanner, "limits": config.limits.model_copy(update=cap)})


def check_format(path: Path, table: dict[str, Any], expected: str, version: int) -> None:
    """Refuse a file of another format or version by name, rather than misread it."""
    if table.get("format") != expected:
        raise InputError(f"{path}: format", table.get("format"), f"'{expected}'")
    if table.get("version") != version:
        raise InputError(f"{path}: version", table.get("version"), f"{version}, the one this release reads")


def build_input_error(error: ValidationError, where: str, model: type[BaseModel] | None = None) -> InputError:
    """The first of pydantic's complaints as one line; an unknown key comes with the nearest known one."""
    complaints = error.errors(include_url=False)
    first = next((item for item in complaints if item["type"] == "extra_forbidden"), complaints[0])
    place = ".".join(str(part) for part in first["loc"])
    label = f"{where}: {place}" if place else where
    if first["type"] == "extra_forbidden":
        known = _list_known_keys(model, first["loc"][:-1]) if model else []
        expected = f"a known key, {suggest_nearest(str(first['loc'][-1]), known)}" if known else "no such key"
        return InputError(label, str(first["loc"][-1]), expected, code="unknown_key")
    message = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    if first["type"] == "missing":
        return InputError(label, None, "this key to be there")
    if first["type"] == "value_error":
        return InputError(label, "values that contradict", message)
    return InputError(label, first["input"], message)


def _list_known_keys(model: type[BaseModel], path: tuple[str | int, ...]) -> list[str]:
    for part in path:
        item = model.model_fields.get(str(part))
        if item is None or not (isinstance(item.annotation, type) and issubclass(item.annotation, BaseModel)):
            return []
        model = item.annotation
    return list(model.model_fields)
