"""The sections of a configuration and their keys."""

import re
from itertools import pairwise
from os.path import realpath
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import AfterValidator, Field, model_validator

from optodrive.core.errors import Unquoted
from optodrive.core.plausibility import PlausibleRange
from optodrive.core.toml_model import ConflictError, Name, Section

WIRE_ON_MAX_S = 65_535e-6
"""Longest gate-on time that one point of the protocol can carry (16 bit, microseconds), s."""

HALF_RANGE_CODES = 32_767
"""Codes of the board's converter from the centre to the end of a mirror's range."""
DAC_HALF_RANGE_CODES = 2_047
"""Half range of a laser DAC: 12 bits, which every converter behind one has."""
POWER_STEPS = 65_535
"""Steps of the board's duty from zero to the laser's full power."""
DAC_POWER_STEPS = {"helios": 255, "ether_dream": 4095, "idn": 255}
"""The same of the laser DACs, by transport."""
NETWORK_DACS = ("ether_dream", "idn")
ETHER_DREAM_CLOCK_HZ = 24_000_000
IDN_STRETCH = 1.3
"""Factor by which OpenIDN's server plays slower while its buffer is almost empty."""
# Counted by the galvo load, which must hold for the points as they are played.
DAC_TIMING_SLACK_POINTS = {"helios": 5, "ether_dream": 5, "idn": 6}
"""On a laser DAC a pulse starts up to two points late (rounding; the end of a chunk) and ends up to three points early
(the same, and the dark point before an immediately following pulse); on IDN one more dark point precedes a pulse."""
CLOCKED_DACS = ("helios", "ether_dream")
"""Laser DACs that play positions and light by one clock at the rate that they are asked for."""
DAC_POINT_EXCESS_S = {"helios": 1e-8, "ether_dream": 5e-8, "idn": 1e-6}
"""A point lasts up to one tick of the DAC's clock longer than requested, s."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Duty = Annotated[float, Field(ge=0, le=1)]
CURVE_ROWS_MAX = 1000
"""Rows of a laser's curve: more than any power meter's table needs."""
HalfWidth = Annotated[float, Field(ge=0, le=0.5), PlausibleRange(0.0, 0.5, "1")]
ServoHalfWidth = Annotated[float, Field(ge=0, le=0.3), PlausibleRange(0.0, 0.3, "1")]
Pitch = Annotated[Positive, PlausibleRange(1e-4, 0.1, "m")]
BridgeWidth = Annotated[Positive, PlausibleRange(1e-5, 5e-3, "m")]
FocalLength = Annotated[Positive, PlausibleRange(5e-3, 3.0, "m")]
AbsorberSide = Annotated[Positive, PlausibleRange(5e-5, 0.05, "m")]
PanelSide = Annotated[Positive, PlausibleRange(1e-3, 3.0, "m")]
FocusSide = Annotated[Positive, PlausibleRange(1e-6, 0.05, "m")]
MeanPower = Annotated[Positive, PlausibleRange(1e-4, 60.0, "W")]
Window = Annotated[Positive, PlausibleRange(1e-3, 120.0, "s")]
UsbId = Annotated[int, Field(ge=0, le=0xFFFF)]


class DisplaySection(Section):
    """The pixel lattice: rows × columns at one pitch, centred on the optical axis, without the missing places."""

    rows: Annotated[int, Field(ge=1, le=200)]
    """Number of rows, counted from the bottom."""
    columns: Annotated[int, Field(ge=1, le=200)]
    """Number of columns, counted from the left."""
    pitch_m: Pitch
    """Distance between neighbouring pixels, m."""
    missing: tuple[tuple[int, int], ...] = ()
    """Places without a pixel, as pairs of row and column."""
    bridge_width_m: BridgeWidth
    """Width of the bridges that hold the absorbers, m."""
    absorber_width_m: AbsorberSide = 2.0e-3
    """Width of an absorber in x, m; less than the pitch of several columns."""
    absorber_height_m: AbsorberSide = 1.5e-3
    """Height of an absorber in y, m; less than the pitch of several rows."""
    pixel_map: Annotated[str, Field(min_length=1)] | None = None
    """File with the measured gain, offset and state of every pixel, relative to the configuration's folder."""
    sensitivity_map: Annotated[str, Field(min_length=1)] | None = None
    """File with a person's sensitivity at every pixel, by which an intensity is equalised; in the same folder."""

    @model_validator(mode="after")
    def _check_missing_places(self) -> Self:
        for number, (row, column) in enumerate(self.missing):
            place = f"missing[{number}]"
            if not (0 <= row < self.rows and 0 <= column < self.columns):
                within = f"a place within {self.rows} rows and {self.columns} columns, counted from 0"
                raise ConflictError(place, [row, column], within)
            if (row, column) in self.missing[:number]:
                raise ConflictError(place, [row, column], "each place once")
        if len(self.missing) >= self.rows * self.columns:
            raise ConflictError("missing", Unquoted(f"all {len(self.missing)} places"), "a place with a pixel")
        return self

    @model_validator(mode="after")
    def _check_absorbers(self) -> Self:
        """Refuse absorbers that overlap: pixels in one row are neighbours in x, in one column in y."""
        for side, count in (("width", self.columns), ("height", self.rows)):
            size_m = getattr(self, f"absorber_{side}_m")
            if count > 1 and size_m >= self.pitch_m:
                expected = f"less than pitch_m {self.pitch_m}, for absorbers do not overlap"
                raise ConflictError(f"absorber_{side}_m", size_m, expected)
        return self


class PixelModelSection(Section):
    """The thermal and mechanical model of the pixels."""

    parameters: str = "calibrated"
    """Name of a parameter set in configs/parameters, or a file, model.toml, relative to the configuration's folder."""


class PanelSection(Section):
    """The laminate with its frame, to which all walls lose their heat, and which loses it to the room."""

    width_m: PanelSide | None = None
    """Outer width, m; by default that of the pixels and a rim of 10 mm on either side."""
    height_m: PanelSide | None = None
    """Outer height, m; by default that of the pixels and a rim of 10 mm on either side."""
    resistance_k_per_w: Annotated[Positive, PlausibleRange(1e-3, 1e3, "K/W")] | None = None
    """Thermal resistance to the room, K/W; by default that of still air on both faces."""
    capacity_j_per_k: Annotated[Positive, PlausibleRange(0.1, 1e5, "J/K")] | None = None
    """Heat capacity with all walls, J/K; by default that of a laminate of acrylic and polystyrene."""


class LaserSection(Section):
    """The diode, its modulation and its focus."""

    max_power_w: Annotated[Positive, PlausibleRange(1e-3, 60.0, "W")]
    """Incident power at the sample at full duty, W."""
    pwm_hz: Annotated[Positive, PlausibleRange(50.0, 1e7, "Hz")]
    """Frequency of the pulse-width modulation, Hz; pulses below full power are whole periods wide."""
    modulation: Literal["pwm", "on_off"] = "pwm"
    """Whether the module takes a PWM, or is on or off: then every pulse has full power, and its width in microseconds
    makes its energy."""
    whole_periods: bool = True
    """Whether pulses at full power are whole periods wide, too, and not only whole microseconds, as a module that
    modulates by itself needs."""
    threshold_w: Annotated[float, Field(ge=0), PlausibleRange(0.0, 10.0, "W")] = 0.0
    """Incident power below which the module emits nothing, W, 0 if it has no threshold. No pulse is weaker."""
    curve: Annotated[tuple[tuple[Duty, NonNegative], ...], Field(max_length=CURVE_ROWS_MAX)] = ()
    """Pairs of duty and incident power, W, by a power meter, from [0, 0] to [1, max_power_w]; none: in proportion."""
    focus_width_m: FocusSide
    """Width of the focus on the absorber in x, m."""
    focus_height_m: FocusSide
    """Height of the focus on the absorber in y, m."""

    @model_validator(mode="after")
    def _check_threshold(self) -> Self:
        if self.threshold_w >= self.max_power_w:
            raise ConflictError("threshold_w", self.threshold_w, f"less than max_power_w, {self.max_power_w:g}")
        return self

    @property
    def is_on_off(self) -> bool:
        """Whether every pulse has full power."""
        return self.modulation == "on_off"

    @property
    def width_steps_hz(self) -> float:
        """Number of steps of a pulse's width in a second: PWM periods, or microseconds of a laser that is on or off."""
        return 1e6 if self.is_on_off else self.pwm_hz

    @model_validator(mode="after")
    def _check_curve(self) -> Self:
        for row, (before, after) in enumerate(pairwise(self.curve), start=1):
            if after[0] <= before[0]:
                raise ConflictError(f"curve[{row}]", list(after), f"a duty above {before[0]:g}, that of the row before")
            if after[1] < before[1] or before[1] == after[1] > 0.0:
                raise ConflictError(f"curve[{row}]", list(after), f"more than {before[1]:g} W, as in the row before")
        if self.curve and self.is_on_off:
            raise ConflictError("curve", Unquoted(f"{len(self.curve)} rows"), "none with modulation 'on_off'")
        ends = [0.0, 0.0], [1.0, self.max_power_w]
        for row, end in zip((0, -1), ends, strict=True) if self.curve else ():
            if list(self.curve[row]) != end:
                raise ConflictError(f"curve[{row % len(self.curve)}]", list(self.curve[row]), str(end))
        dark = [number for number, (duty, power_w) in enumerate(self.curve) if duty > 0.0 == power_w]
        if dark and self.threshold_w < self.curve[dark[-1] + 1][1]:
            # Between these two rows the meter has not seen where the light begins.
            expected = f"at least {self.curve[dark[-1] + 1][1]:g}, the first power above 0 of curve"
            raise ConflictError("threshold_w", self.threshold_w, expected)
        return self


class ServoSection(Section):
    """The servo of either mirror: a delay, a slew-limited target, and two underdamped poles."""

    bandwidth_hz: Annotated[float, Field(ge=100, le=100_000), PlausibleRange(100.0, 1e5, "Hz")]
    """Natural frequency of the closed loop, Hz."""
    damping: Annotated[float, Field(ge=0.3, le=0.9)]
    """Damping ratio of the closed loop."""
    delay_s: Annotated[float, Field(ge=0, le=0.01), PlausibleRange(1e-9, 2e-3, "s")]
    """Time from a command to the first movement of the servo's target, s."""
    slew_rad_per_s: Annotated[float, Field(ge=1, le=100_000), PlausibleRange(1.0, 1500.0, "rad/s")]
    """Speed at which the servo's target moves to the command, rad/s."""
    bandwidth_uncertainty: ServoHalfWidth = 0.1
    """Half-width of bandwidth_hz, relative. The gate opens when every servo within these half-widths has settled."""
    damping_uncertainty: ServoHalfWidth = 0.1
    """Half-width of damping, relative."""
    slew_uncertainty: ServoHalfWidth = 0.1
    """Half-width of slew_rad_per_s, relative."""
    delay_uncertainty_s: Annotated[float, Field(ge=0, le=0.01), PlausibleRange(0.0, 2e-3, "s")] = 1e-5
    """Half-width of delay_s, s."""


class Wiring(NamedTuple):
    """Relation of the converter's outputs X and Y to the axes of the display, by the keys of ScannerSection."""

    swap_axes: bool = False
    invert_x: bool = False
    invert_y: bool = False


DIRECT_WIRING = Wiring()
"""Output X along x, output Y along y."""


class ScannerSection(ServoSection):
    """The mirrors and the lens. Without a calibrated field the lens is an ideal f-theta lens, x = f · 2 · angle."""

    focal_length_m: FocalLength
    """Focal length of the f-theta lens, m."""
    range_rad: Annotated[float, Field(gt=0, lt=0.8), PlausibleRange(1e-3, 0.8, "rad")]
    """Mechanical mirror angle at either end of the converter's range, rad."""
    aim_error_m: Annotated[NonNegative, PlausibleRange(1e-9, 5e-3, "m")]
    """Largest distance of a settled beam from its target, m."""
    field: Annotated[str, Field(min_length=1)] | None = None
    """File of a calibrated scan field that replaces the ideal lens, relative to the configuration's folder."""
    mirrors: Annotated[str, Field(min_length=1)] | None = None
    """File of measured servos that replace the stated one, relative to the configuration's folder."""
    trajectories: Literal["steps", "early_steps"] = "steps"
    """When a step to the next pixel is sent: as the light ends, or as early as the focus stays on the absorber."""
    interface: Literal["analog", "xy2-100"] = "analog"
    """How the board moves the mirrors: by two voltages, or by frames of XY2-100. A move takes up to two frames, 20 µs
    that delay_s includes."""
    feedback: bool = False
    """Whether the board measures the mirrors by the galvo driver's position outputs, and permits light only where they
    are: within half a pixel's distance."""
    half_range_codes: int = HALF_RANGE_CODES
    """Codes of the converter from the centre to the end of the range: 32767, for a laser DAC 2047."""

    swap_axes: bool = False
    """Whether output X moves the beam along y, and output Y along x."""
    invert_x: bool = False
    """Whether the sign of output X is turned: a larger code of it moves the beam to smaller x, or y if swapped."""
    invert_y: bool = False
    """Whether the sign of output Y is turned."""

    @property
    def wiring(self) -> Wiring:
        """Relation of the converter's outputs to the axes of the display."""
        return Wiring(self.swap_axes, self.invert_x, self.invert_y)

    @property
    def rad_per_code(self) -> float:
        """Mirror angle of one code of the converter, rad."""
        return self.range_rad / self.half_range_codes


class UncertaintySection(Section):
    """Declared half-widths of the model's parameters, relative unless stated. The limiter covers the whole box."""

    absorbed_power: HalfWidth = 0.03
    """Absorbed power."""
    bridge_resistance: HalfWidth = 0.02
    """Thermal resistance of the bridges."""
    absorber_capacity: HalfWidth = 0.05
    """Heat capacity of an absorber."""
    exponent: HalfWidth = 0.02
    """Exponent of the bridge resistance in temperature, absolute; it is 0 in a set without bridge_conductivity."""
    gas_lag: HalfWidth = 0.25
    """Time constant of the gas."""
    wall_resistance: HalfWidth = 0.02
    """Thermal resistance from a wall to the surroundings."""
    wall_capacity: HalfWidth = 0.1
    """Heat capacity of a wall."""
    side_resistance: HalfWidth = 0.1
    """Thermal resistance between neighbouring walls."""
    touch_share: HalfWidth = 0.02
    """Shares of the gas and of the wall in the touch surface's temperature."""
    touch_lag: HalfWidth = 0.1
    """Time constant of the touch surface."""
    panel_resistance: HalfWidth = 0.2
    """Thermal resistance from the panel to the room."""
    panel_capacity: HalfWidth = 0.2
    """Heat capacity of the panel."""


class LimitsSection(Section):
    """Caps that no sequence of plans exceeds."""

    power_share: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Largest power of a pulse as a share of the laser's; `optodrive dim` lowers it further while the daemon runs."""
    absorber_max_c: Annotated[float, PlausibleRange(1.0, 560.0, "°C")]
    """Highest absorber temperature, °C."""
    wall_max_c: Annotated[float, PlausibleRange(1.0, 200.0, "°C")]
    """Highest wall temperature, °C, if the parameter set has walls and touch_max_c is not lower."""
    touch_max_c: Annotated[float, PlausibleRange(1.0, 90.0, "°C")]
    """Highest temperature of all that a finger touches, °C: touch surfaces and walls, if any, and the panel."""
    galvo_acceleration_rms_max_rad_per_s2: Annotated[Positive, PlausibleRange(1.0, 1e6, "rad/s²")]
    """Root mean square of either mirror's angular acceleration, rad/s²."""
    galvo_mean_s: Annotated[float, Field(ge=0.05), PlausibleRange(1e-3, 100.0, "s")]
    """Averaging time of the galvo acceleration, s."""
    pulse_energy_max_j: Annotated[Positive, PlausibleRange(1e-6, 10.0, "J")]
    """Incident energy of a pulse, and of a pixel's leaky bucket, J."""
    pulse_width_max_s: Annotated[float, Field(gt=0, le=WIRE_ON_MAX_S), PlausibleRange(1e-7, 0.07, "s")]
    """Gate-on time of a pulse, s."""
    pulse_gap_min_s: Annotated[float, Field(gt=0, le=0.01), PlausibleRange(1e-9, 0.01, "s")] = 5e-4
    """Pulses on a pixel with a shorter gap count as one against pulse_width_max_s, s."""
    pixel_mean_power_max_w: MeanPower
    """Mean incident power of a pixel over its window, and leak rate of its energy bucket, W."""
    pixel_mean_window_s: Window
    """Averaging window of a pixel's mean power, s."""
    display_mean_power_max_w: MeanPower
    """Mean incident power of the display over its window, W."""
    display_mean_window_s: Window
    """Averaging window of the display's mean power, s."""
    stage_skew_max_s: Annotated[float, Field(gt=0, le=0.01), PlausibleRange(1e-7, 0.01, "s")] = 1e-3
    """Largest error of the clock of one of several stages, s; a plan starts on none if one may be further off."""
    uncertainty: UncertaintySection = UncertaintySection()
    """Declared uncertainty of the model."""


class BoardSection(Section):
    """The board and the way to reach it."""

    transport: Literal["simulated", "serial", "usb", "helios", "ether_dream", "idn"]
    """The simulated board, a serial port, USB bulk endpoints, or a laser DAC: by USB (Helios) or network."""
    port: str = ""
    """Serial device, link of the simulated board's pseudo-terminal, or address of a network DAC."""
    baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 1_000_000
    """Bit rate of the serial port, 1/s."""
    uid: str = ""
    """The only board, or name of a laser DAC, that is accepted; empty: any."""
    lease_s: Annotated[float, Field(ge=0.02, le=1.0), PlausibleRange(1e-3, 1.0, "s")] = 0.1
    """Time after the last lease until the board closes the gate, s."""
    stream_lead_s: Annotated[float, Field(ge=0.01, le=0.2), PlausibleRange(1e-3, 0.2, "s")] = 0.03
    """Time for which points of a stream are sent ahead, s; a longer stall of this computer interrupts the stream."""
    vendor_id: UsbId | None = None
    """USB vendor of the board."""
    product_id: UsbId | None = None
    """USB product of the board."""
    serial_number: str = ""
    """USB serial number of a USB board, a Helios, or the serial port of a service; empty: the only one of its kind."""
    points_per_s: Annotated[int, Field(ge=20_000, le=50_000)] = 40_000
    """Point rate of a laser DAC, 1/s."""
    interlock_watched: bool = False
    """Statement that an external interlock cuts the laser's supply; a laser DAC emits nothing without it."""

    @model_validator(mode="after")
    def _check_address(self) -> Self:
        if self.transport == "serial" and not self.port:
            raise ConflictError("port", self.port, "a device for transport 'serial', for example \"/dev/ttyACM0\"")
        if self.transport in NETWORK_DACS and not self.port:
            raise ConflictError("port", self.port, 'the DAC\'s address, for example "192.168.1.20"')
        if self.transport in NETWORK_DACS and self.serial_number:
            raise ConflictError(
                "serial_number", self.serial_number, "none: a network DAC has a uid, which `info` shows"
            )
        for key, example in (("vendor_id", "0x1209"), ("product_id", "0x0001")):
            if self.transport == "usb" and getattr(self, key) is None:
                raise ConflictError(key, None, f"a number for transport 'usb', for example {example}")
        return self

    @property
    def address(self) -> tuple[str | int | None, ...]:
        """Properties that tell the board from others on this computer, empty for a simulated one."""
        if self.transport == "simulated":
            return ()
        if self.transport == "serial":
            return (self.transport, realpath(self.port))
        if self.transport in NETWORK_DACS:
            return (self.transport, self.port)
        return (self.transport, self.vendor_id, self.product_id, self.serial_number, self.uid)

    @property
    def is_numbered(self) -> bool:
        """Whether the port's name is a number that the kernel gives in the order in which ports appear."""
        return self.transport == "serial" and re.fullmatch(r"/dev/tty(ACM|USB)\d+", self.port) is not None

    @property
    def timing_slack_s(self) -> float:
        """Largest reduction of the interval between two planned times on this board, s, and zero for ticks."""
        if not self.is_dac:
            return 0.0
        return DAC_TIMING_SLACK_POINTS[self.transport] * self.point_max_s

    @property
    def stretch(self) -> float:
        """Largest factor by which a point of the laser DAC may last longer, for which its levels are lower."""
        if self.transport == "ether_dream":
            # Sources differ in whether its counter includes its last value.
            return 1.0 + 1.0 / (ETHER_DREAM_CLOCK_HZ // self.points_per_s)
        return IDN_STRETCH if self.transport == "idn" else 1.0

    @property
    def point_max_s(self) -> float:
        """Longest duration of a point of the laser DAC, s."""
        return 1.0 / self.points_per_s + DAC_POINT_EXCESS_S[self.transport]

    @property
    def is_dac(self) -> bool:
        """Whether the transport is a laser DAC, which does not speak the board's protocol."""
        return self.transport in DAC_POWER_STEPS


class SensorSection(Section):
    """A spot sensor on its own serial port (SENSOR.md). A simulated board includes one."""

    port: Annotated[str, Field(min_length=1)]
    """Serial device of the sensor."""
    baud: Annotated[int, Field(ge=1200, le=12_000_000)] = 115_200
    """Bit rate of its port, 1/s."""


class StageSection(Section):
    """One optical stage of several over one display, with its own laser, scanner and board.

    Its tables laser, scanner and board state what differs from the sections above, the board's port at least. Without
    stages, those sections describe the only one.
    """

    name: Name
    """Name of the stage."""
    rows: tuple[int, int] | None = None
    """First and last row that its beam reaches; by default all."""
    columns: tuple[int, int] | None = None
    """First and last column that its beam reaches; by default all."""
    laser: LaserSection
    """Its laser."""
    scanner: ScannerSection
    """Its mirrors and lens."""
    board: BoardSection
    """Its board."""


def _require_address(text: str) -> str:
    if not text:  # would listen on every address
        raise ValueError("an address of this computer, 127.0.0.1 to be reached from here only")
    return text


def _require_host_name(text: str) -> str:
    if not re.fullmatch(r"\[[0-9a-fA-F:.]+\]|[^\[\]:/?#@\s]+", text):
        raise ValueError("a name or address without scheme, port and path, as in lab.example or [fd00::1]")
    return text


class DaemonSection(Section):
    """Addresses, access and files of the daemon."""

    host: Annotated[str, AfterValidator(_require_address)] = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, Field(ge=0, le=65_535)] = 8450
    """TCP port; 0: any free one."""
    socket: str = ""
    """Path of an additional Unix socket."""
    hosts: tuple[Annotated[str, AfterValidator(_require_host_name)], ...] = ()
    """Accepted names in the Host and Origin headers besides loopback."""
    body_max_bytes: Annotated[int, Field(ge=1024, le=64_000_000)] = 8_000_000
    """Largest request body, bytes."""
    tokens: str = ""
    """File of permanent tokens; empty: new tokens at each start."""
    audit: str = ""
    """File to which arming, stopping and pushing are appended."""
    requests_per_s: Annotated[float, Field(ge=1, le=100_000)] = 500.0
    """Sustained request rate of one client, 1/s; STOP is exempt."""
    requests_burst: Annotated[int, Field(ge=1, le=100_000)] = 1000
    """Requests of one client at once."""
    record: str = ""
    """Folder for a recording of each session."""
    on_web_loss: Literal["dark", "finish"] = "dark"
    """End of the web process while a plan runs: go dark at once, or finish the plan."""
    on_stage_loss: Literal["all_dark", "that_stage"] = "all_dark"
    """Loss of one of several stages while they are armed: all go dark, or the others draw what is left."""
