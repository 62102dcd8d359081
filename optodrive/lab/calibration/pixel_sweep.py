"""Sweep of pulses that determine every pixel's gain and offset, and its journal.

Each pixel gets one pulse at each of a few aims. Across an edge, part of the focus misses the absorber and falls on the
wall, which the limiter does not model. Those pulses are weak enough to keep even black acrylic below the wall's cap.

The journal has one line of CSV per executed pulse, written while the sweep runs. A line is one write, so a process that
is killed leaves all earlier lines; a line without its end is dropped on reading.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from optodrive.core.errors import InputError, refuse_os_error
from optodrive.core.laser_power import ROUNDING
from optodrive.core.types.arrays import BoolArray
from optodrive.core.types.measurements import Measurement, Run
from optodrive.core.types.stimuli import PulseTrain
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.pixel_map import PixelMap
from optodrive.device.scan_field import ScanField
from optodrive.lab.calibration.pixel_fit import Optics

EDGE_FRACTIONS = (0.7, 0.3)
"""Nominal fractions of the focus on the absorber for aims across an edge."""
ENERGY_FRACTION = 0.1
"""Fraction of the largest allowed pulse energy, for pulses on the middle."""
WALL_HEADROOM_FRACTION = 0.8
"""Fraction of the headroom below limits.wall_max_c, for pulses that partly miss the absorber."""
ACRYLIC_EFFUSIVITY_W_S05_PER_M2_K = (0.19 * 1.75e6) ** 0.5
"""Thermal effusivity of acrylic: 0.19 W/(m K), and 1.75 MJ/(m³ K), Table S4."""
GATE_OFF_S = 0.05
"""Time from a pulse's end to the next pulse on any pixel, s; gas and absorber are cold after a few of them."""
PRE_PULSE_S = 0.02
"""Time from the start of a run to its pulse, as `calibrate pixels` asks for."""


class Aim(NamedTuple):
    """Position of the beam from each pixel's middle, m.

    name: of its files
    """

    name: str
    x_m: float
    y_m: float


def list_aims(config: Config) -> list[Aim]:
    """Return the middle, and two aims across each edge."""
    optics, aims = Optics.from_config(config), [Aim("middle", 0.0, 0.0)]
    for sign, suffix in ((-1.0, "minus"), (1.0, "plus")):
        for axis, name in enumerate("xy"):
            for k, fraction in enumerate(EDGE_FRACTIONS, 1):
                offset_m = optics.absorber_half_m[axis] + (1.0 - 2.0 * fraction) * optics.focus_half_m[axis]
                place_m = [0.0, 0.0]
                place_m[axis] = round(sign * offset_m, 9)
                aims.append(Aim(f"{name}-{suffix}-{k}", *place_m))
    return aims


def compute_pitch_min_m(config: Config, aims: list[Aim]) -> float:
    """Return the smallest pitch at which the focus stays in the pixel's cell at every aim, m."""
    offset_m = np.abs([(aim.x_m, aim.y_m) for aim in aims])
    return float((2.0 * offset_m + [config.laser.focus_width_m, config.laser.focus_height_m]).max())


def compute_pulse(config: Config, aim: Aim) -> tuple[float, float]:
    """Return width, s, and power, W, of an aim's pulses: short ones on the middle, weak ones across an edge."""
    laser, limits = config.laser, config.limits
    if aim.x_m == aim.y_m == 0.0:
        energy_j = ENERGY_FRACTION * limits.pulse_energy_max_j
        steps = max(1, int(energy_j / laser.max_power_w * laser.width_steps_hz))
        width_s = min(steps / laser.width_steps_hz, limits.pulse_width_max_s)
        return width_s, max(config.min_power_w, min(laser.max_power_w, energy_j / width_s))
    steps = int(limits.pulse_width_max_s * laser.width_steps_hz + 1e-6)
    while steps > 1 and edge_power_max_w(config, steps / laser.width_steps_hz) < config.min_power_w:
        steps = int(0.99 * steps)
    width_s = steps / laser.width_steps_hz
    max_w = edge_power_max_w(config, width_s)
    if max_w < config.min_power_w * (1.0 - ROUNDING):
        expected = f"at most {max_w:.3g} W across the edge of an absorber, where the light falls on walls"
        raise InputError("laser.threshold_w", laser.threshold_w, expected)
    return width_s, max(config.min_power_w, max_w)


def edge_power_max_w(config: Config, width_s: float) -> float:
    """Return the power at which a wall that absorbs all the light stays below its cap, W.

    The surface of a half-space rises with √t over its effusivity. The rises by the mean power and by the ripple of the
    PWM are added; each grows with the square root of its duration.
    """
    laser, limits = config.laser, config.limits
    headroom_k = WALL_HEADROOM_FRACTION * (limits.wall_max_c - config.ambient_c)
    area_m2 = laser.focus_width_m * laser.focus_height_m
    rise_k_per_w_s05 = 2.0 / (ACRYLIC_EFFUSIVITY_W_S05_PER_M2_K * np.pi**0.5 * area_m2)
    mean = rise_k_per_w_s05 * width_s**0.5
    ripple = rise_k_per_w_s05 * (laser.max_power_w / laser.width_steps_hz) ** 0.5
    root = (-ripple + np.sqrt(ripple**2 + 4.0 * mean * headroom_k)) / (2.0 * mean)
    energy_w = ENERGY_FRACTION * limits.pulse_energy_max_j / width_s
    return float(min(root**2, energy_w, laser.max_power_w))


def is_reachable(config: Config, field: ScanField, aim: Aim) -> BoolArray:
    """Return for which pixels an aim is within the range of the mirrors, [p]."""
    layout, range_rad = build_pixel_layout(config.display), config.scanner.range_rad
    angles_rad = field.angles_rad(layout.x_m + aim.x_m, layout.y_m + aim.y_m)
    within = [np.abs(angle_rad) <= range_rad for angle_rad in angles_rad]  # False for NaN, outside a calibrated field
    return np.asarray(within[0] & within[1], dtype=np.bool_)


def build_aim_map(aim: Aim, reached: BoolArray) -> PixelMap:
    """Return the pixel map that moves the beam of every pixel to an aim. Pixels that it does not reach stay."""
    unmoved = PixelMap.uniform(len(reached))
    return replace(unmoved, offset_x_m=np.where(reached, aim.x_m, 0.0), offset_y_m=np.where(reached, aim.y_m, 0.0))


def build_sweep(config: Config, aim: Aim, included: BoolArray) -> tuple[PulseTrain, ...]:
    """Build one pulse per included pixel, in an order without successive neighbours."""
    layout, (width_s, power_w) = build_pixel_layout(config.display), compute_pulse(config, aim)
    order = np.lexsort((layout.column, layout.row, layout.column % 2, layout.row % 2))
    slot_s = width_s + GATE_OFF_S
    return tuple(
        PulseTrain(int(pixel), round(k * slot_s, 6), width_s, width_s, GATE_OFF_S, power_w)
        for k, pixel in enumerate(order[included[order]])
    )


class SweepPulse(NamedTuple):
    """An executed pulse.

    start_unix_s: gate on, by the host's clock
    start_board_s: by the board's
    """

    aim: str
    pixel: int
    start_unix_s: float
    start_board_s: float
    width_s: float
    power_w: float


HEADER = ",".join(SweepPulse._fields)


class SweepJournal:
    """The journal of one display in a file.

    Its own thread writes it, because a disk may take longer than a lease.
    """

    def __init__(self, path: Path, pulses: list[SweepPulse], file: int) -> None:
        self.path, self.pulses = path, pulses
        self._file = file
        self._error: OSError | None = None
        self._writer = ThreadPoolExecutor(1, "sweep journal")

    @classmethod
    def open(cls, path: Path, display: str) -> Self:
        """Open the journal of a display, or create it. Raise InputError for another display's or another file."""
        head = f"# optodrive sweep of {display}\n{HEADER}\n"
        with refuse_os_error(path, "a file that can be written"):
            text = path.read_text(encoding="utf-8") if path.exists() else ""
            complete = text[: text.rfind("\n") + 1] or head
            if not complete.startswith(head):
                raise InputError(str(path), complete.splitlines()[0], f"{head.splitlines()[0]!r}, and {HEADER}")
            pulses = [_parse_line(path, number, line) for number, line in enumerate(complete.splitlines()[2:], 3)]
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.ftruncate(file, len(complete.encode()) if text else 0)
            if not text:
                os.write(file, head.encode())
        return cls(path, pulses, file)

    def list_done(self, aim: str) -> frozenset[int]:
        """Return the pixels whose pulse at an aim was executed."""
        return frozenset(pulse.pixel for pulse in self.pulses if pulse.aim == aim)

    def append(self, pulses: list[SweepPulse]) -> None:
        """Append pulses without waiting for the disk. Raise InputError if an earlier write failed."""
        self.raise_if_failed()
        self.pulses += pulses
        self._writer.submit(self._write, "".join(",".join(map(str, pulse)) + "\n" for pulse in pulses))

    def raise_if_failed(self) -> None:
        """Raise InputError if a write failed."""
        if self._error is not None:
            raise InputError(str(self.path), self._error.strerror, "a file that can be written")

    def close(self) -> None:
        """Write the remaining lines and close the file."""
        self._writer.shutdown()
        os.close(self._file)

    def _write(self, lines: str) -> None:
        try:
            if self._error is None:
                os.write(self._file, lines.encode())
                os.fdatasync(self._file)
        except OSError as error:
            self._error = error


def _parse_line(path: Path, number: int, line: str) -> SweepPulse:
    try:
        aim, pixel, *numbers = line.split(",")
        start_unix_s, start_board_s, width_s, power_w = map(float, numbers)
        return SweepPulse(aim, int(pixel), start_unix_s, start_board_s, width_s, power_w)
    except ValueError:
        raise InputError(f"{path}, line {number}", line[:80], HEADER) from None


def build_runs(pulses: list[SweepPulse], aims: list[Aim], display: str, ambient_k: float) -> Measurement:
    """Build one run per pixel and aim, with its pulse at PRE_PULSE_S, to be merged with measured signals."""
    offsets = {aim.name: aim for aim in aims}
    runs = []
    for pulse in pulses:
        rows = np.array([[PRE_PULSE_S, pulse.width_s, pulse.power_w, float(pulse.pixel)]])
        attributes: dict[str, str | float] = {"aim_x_m": offsets[pulse.aim].x_m, "aim_y_m": offsets[pulse.aim].y_m}
        attributes |= {"display": display, "started_unix_s": pulse.start_unix_s - PRE_PULSE_S}
        runs.append(Run(f"{pulse.aim}-{pulse.pixel:04d}", ambient_k, rows, {}, attributes))
    return Measurement(tuple(runs))
