"""Firmware of a Raspberry Pi Pico for one display: its settings from a configuration, and its image by make.

No host can loosen what the settings state, so they are those that the display requires and no more: caps and settling
as a simulated board of that display has them (`permit_retiming`), and a range of the mirrors that spans the pixels and
the margin of the tasks that calibrate. Everything else of the image is the same for every display.
"""

import re
import shutil
import subprocess
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

from optodrive.core.errors import InputError, LinkError, Unquoted
from optodrive.core.laser_power import find_proportional_power_w
from optodrive.core.quantity import format_quantity
from optodrive.device.config import Config
from optodrive.link.board_setup import SIMULATED_CELL_MAX_CODES, build_bench_requirements, permit_retiming
from optodrive.link.protocol.messages import Limits

CELLS_MAX = 1520
"""Spots that a Pico can guard: BOARD_CELLS of its Makefile."""
PREFERRED_GATE_HZ = 50_000.0
GATE_MIN_HZ, GATE_MAX_HZ = 30_000.0, 488_000.0
"""PWM frequencies of the pin: the readback holds from a pulse to the next, and a period has 256 steps."""
CHIPS = {"rp2040": "", "rp2350": "pico2"}
"""The chip of a board → the folder and the target of its image."""
INTERFACES = {"analog": "INTERFACE_ANALOG", "xy2-100": "INTERFACE_XY2_100"}
"""The interface to the mirrors → its name in the firmware."""
TOOLS = {"make": "make", "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi", "python3": "python3"}
"""Programs that build an image, by the packages of Debian that have them."""

HEADER = """/* Settings of the board of {name}, by `optodrive board settings`: its limits, which no host can loosen. */

#ifndef SETTINGS_H
#define SETTINGS_H

#include "chip.h"

#define HOST_BAUD {baud}u
#define GATE_HZ {gate_hz}u
#define BOARD_UID {{{uid}}}

static const struct board_config SETTINGS = {{
    .limits =
        {{
{limits}
        }},
    .uid = BOARD_UID,
    .firmware = FIRMWARE,
    .cell_codes = {cell_codes},
    .queue_points = BOARD_QUEUE_POINTS,
    .cells = BOARD_CELLS,
    .window_pulses = BOARD_PULSES,
    .key_edge = true,
    .interface = {interface},
    .feedback_codes = {feedback_codes},
}};

#endif
"""


class PicoSettings(NamedTuple):
    """The settings of a Pico.

    uid: 24 hexadecimal digits; gate_hz: PWM frequency of the gate, Hz; interface: to the mirrors, of the configuration
    feedback_codes: that a measured mirror may be away from its command, 0: the board does not measure it
    """

    limits: Limits
    cell_codes: int
    gate_hz: int
    baud: int
    interface: str
    feedback_codes: int
    uid: str

    def to_header(self, name: str) -> str:
        """Return settings.h for the display of this name, which may neither end nor begin a comment of C."""
        limits = "\n".join(f"            .{key} = {value}," for key, value in asdict(self.limits).items())
        uid = ", ".join(f"0x{byte:02x}" for byte in bytes.fromhex(self.uid))
        return HEADER.format(
            **self._asdict()
            | {
                "name": name.replace("/", " "),
                "limits": limits,
                "uid": uid,
                "interface": INTERFACES[self.interface],
            }
        )


def build_pico_settings(config: Config, margin_m: float, uid: str) -> PicoSettings:
    """Build the settings for the display of a configuration with one stage.

    margin_m: distance beyond the outermost pixels to which the mirrors may move, m; uid: unless the configuration
    states one. Raises InputError for a display that a Pico cannot guard, or a PWM frequency that it cannot make.
    """
    if config.board.transport not in ("serial", "usb", "simulated"):
        raise InputError("board.transport", config.board.transport, "serial or usb, as a board of one's own has")
    if config.board.uid and not re.fullmatch(r"[0-9a-fA-F]{24}", config.board.uid):
        raise InputError("board.uid", config.board.uid, "24 hexadecimal digits, as a board's uid has")
    requirements = build_bench_requirements(config, margin_m)
    if requirements.pixels > CELLS_MAX:
        raise InputError("display pixels", requirements.pixels, f"at most {CELLS_MAX}, the spots that a Pico can guard")
    return PicoSettings(
        limits=permit_retiming(requirements.limits),
        cell_codes=min(SIMULATED_CELL_MAX_CODES, requirements.cell_max_codes),
        gate_hz=_choose_gate_hz(config.laser.pwm_hz),
        baud=config.board.baud,
        interface=config.scanner.interface,
        feedback_codes=requirements.feedback_codes,
        uid=config.board.uid.lower() or uid,
    )


def _choose_gate_hz(pwm_hz: float) -> int:
    """Return the multiple of the planned PWM frequency nearest to the preferred one: whole periods stay whole."""
    gate_hz = pwm_hz * max(1, round(PREFERRED_GATE_HZ / pwm_hz))
    if not GATE_MIN_HZ <= gate_hz <= GATE_MAX_HZ:
        expected = f"a frequency with a multiple from {format_quantity(GATE_MIN_HZ, 'Hz')} to "
        raise InputError("laser.pwm_hz", pwm_hz, expected + format_quantity(GATE_MAX_HZ, "Hz"))
    return round(gate_hz)


def list_origins(config: Config) -> dict[str, str]:
    """Return the origin of each setting: measured, or declared."""
    scanner = config.scanner

    def state(path: str | None, declared: str) -> str:
        return f"measured: {Path(path).name}" if path else f"declared: {declared}"

    laser = config.laser
    full_w = find_proportional_power_w(laser.max_power_w, laser.curve)
    if laser.curve:
        full_power = f"measured: laser.curve, whose largest ratio of power to duty is {format_quantity(full_w, 'W')}"
    else:
        full_power = f"declared: laser.max_power_w, {format_quantity(full_w, 'W')}; "
        full_power += "a power meter at the sample must show it at full duty"
    return {
        "full power": full_power,
        "range": state(scanner.field, "scanner.focal_length_m, range_rad and the pixels"),
        "settling": state(scanner.mirrors, "scanner.bandwidth_hz, damping, slew_rad_per_s, delay_s"),
        "spots": state(config.display.pixel_map, "the places of the pixels"),
        "caps": "declared: limits.pulse_width_max_s, pulse_energy_max_j, pixel_mean_power_max_w, 5 % above the plans'",
    }


def build_image(firmware: Path, header: str, chip: str) -> bytes:
    """Build the UF2 of a board. Raise InputError without the compiler, LinkError if it fails.

    firmware: the folder firmware_protocol; header: settings.h; chip: one of CHIPS
    """
    make = shutil.which("make")
    missing = [packages for tool, packages in TOOLS.items() if shutil.which(tool) is None]
    if make is None or missing:
        raise InputError("PATH", Unquoted("no compiler for the board"), f"Debian's {' '.join(missing)}")
    with tempfile.TemporaryDirectory() as name:
        folder, port = Path(name), firmware / "ports" / "rp2040"
        settings = folder / "settings.h"
        settings.write_text(header)
        options = [f"BUILD={folder / 'build'}", f"SETTINGS={settings}", *filter(None, [CHIPS[chip]])]
        built = subprocess.run([make, "-s", "-C", port, *options], capture_output=True, text=True, check=False)
        if built.returncode:
            reason = next((line for line in built.stderr.splitlines() if "error" in line), "no reason")
            raise LinkError(f"make ended with {built.returncode}: {reason}")
        return (folder / "build" / CHIPS[chip] / "board.uf2").read_bytes()
