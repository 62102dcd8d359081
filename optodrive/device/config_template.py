"""Text of a new configuration: a shipped one, with its comments, and with the values of another display."""

import json
from dataclasses import dataclass
from pathlib import Path

from optodrive.core.errors import InputError
from optodrive.core.plausibility import PlausibleRange, collect_ranges, describe_likely_unit
from optodrive.core.toml_model import parse_toml
from optodrive.device.config import Config
from optodrive.device.config_file import build_config, load_config, locate_shipped
from optodrive.device.config_sections import DAC_HALF_RANGE_CODES, DAC_POWER_STEPS, NETWORK_DACS

TEMPLATE = "display-16"
SIMULATED = "simulated"
FULL_SIZE_PITCH_M = 3.5e-3
"""Smallest pitch at which absorbers and focus keep the size that they have in the template.

Below it both shrink with the pitch. Across an edge of the absorber, a sweep of the pixels moves the focus by up to
1.7 mm from the middle, its half width included, and may not leave the pixel's cell.
"""
POINTS_PER_CIRCLE = 12
"""Points of the circle in ILDA's test pattern, which falls by about 3 dB at the rate for which galvos are rated."""
RATED_HALF_WIDTH = 0.3
"""Half-width of what a rating says of a servo: circles of dampings of 0.5 to 0.87 fall alike."""
HEAD_LINES = 2
"""Lines of the template that describe its display."""


@dataclass(frozen=True)
class NewDisplay:
    """Values that tell a new display from the template, in SI units.

    port: a serial device, `simulated`, or a laser DAC as `split_port` reads it
    kpps: rating of the galvos at 8°, thousands of points per second, None if the template's servo stays
    """

    name: str
    rows: int
    columns: int
    pitch_m: float
    power_w: float
    focal_length_m: float
    port: str
    kpps: float | None = None


def write_template(display: NewDisplay, path: Path) -> tuple[str, Config]:
    """Return the text of a valid configuration of a display, and the configuration.

    path: of the file that the text is for. Raises InputError for a display that no configuration describes.
    """
    template = locate_shipped(f"{TEMPLATE}.toml").read_text(encoding="utf-8")
    config = build_config(path, parse_toml(template.encode(), TEMPLATE))
    lines, section = template.splitlines()[HEAD_LINES:], ""
    values = _list_values(display, config)
    head = f"{display.rows * display.columns} pixels, {display.rows} x {display.columns}"
    written = [
        f"# {head}, pitch {display.pitch_m * 1e3:g} mm",
        "# Written by `optodrive config new` from the display of the paper: check every number against your own parts.",
    ]
    for line in lines:
        if line.startswith("["):
            section = line.strip("[]")
        key = line.partition(" ")[0]
        written.append(values.pop((section, key), line))
        if (section, key) == ("board", "transport"):
            written += _list_address(*split_port(display.port))
        if (section, key) == ("scanner", "slew_rad_per_s") and split_port(display.port)[0] in DAC_POWER_STEPS:
            written.append(f"half_range_codes = {DAC_HALF_RANGE_CODES}".ljust(34) + "# 12 bits of the laser DAC")
        if (section, key) == ("scanner", "slew_rad_per_s") and display.kpps is not None:
            written += _list_half_widths(config)
    text = "\n".join(written) + "\n"
    return text, build_config(path, parse_toml(text.encode(), str(path)))


def split_port(port: str) -> tuple[str, str]:
    """Return transport and address of a port: a serial device, `simulated`, `helios`, or a network DAC's `KIND:HOST`.

    The transport is '' for anything else.
    """
    if port.startswith("/"):
        return "serial", port
    transport, _, address = port.partition(":")
    is_network = transport in NETWORK_DACS
    is_known = transport in (SIMULATED, *DAC_POWER_STEPS) and bool(address) == is_network
    return transport if is_known else "", address


def _list_address(transport: str, address: str) -> list[str]:
    lines = [f"port = {json.dumps(address)}"] if address else []
    if transport in DAC_POWER_STEPS:
        lines.append("interlock_watched = false".ljust(34) + "# true once an external interlock cuts the laser")
    return lines


def _list_half_widths(template: Config) -> list[str]:
    """Return the lines of the servo's half-widths for galvos of which only a rating is known."""
    keys = ("bandwidth_uncertainty", "damping_uncertainty", "slew_uncertainty")
    note = "# a rating says no more; see calibrate servo"
    lines = [f"{key} = {RATED_HALF_WIDTH:g}".ljust(34) + note for key in keys]
    return [*lines, f"delay_uncertainty_s = {template.scanner.delay_s:g}".ljust(34) + "# it says nothing of the delay"]


def check_number(option: str, value: float, key: str, unit: str) -> None:
    """Raise InputError for a number that the configuration's key cannot hold.

    unit: of value: the key's, or mm for one in m
    """
    plausible = collect_ranges(Config)[key]
    if unit != plausible.unit:
        plausible = PlausibleRange(plausible.low * 1e3, plausible.high * 1e3, unit)
    if not plausible.low <= value <= plausible.high:
        likely = describe_likely_unit(value, plausible) if value > 0.0 else ""
        raise InputError(option, value, f"{plausible.low:g} to {plausible.high:g} {unit}{likely}")


def check_lens(option: str, lens_mm: float, farthest_m: float) -> None:
    """Raise InputError for a lens with which the template's mirrors reach no pixel this far from the middle."""
    check_number(option, lens_mm, "scanner.focal_length_m", "mm")
    range_rad = load_config(TEMPLATE).scanner.range_rad
    needed_mm = 1e3 * farthest_m / (2.0 * range_rad)
    if lens_mm < needed_mm:
        expected = f"at least {needed_mm:.4g} mm: mirrors of ±{range_rad:g} rad must reach every pixel"
        raise InputError(option, lens_mm, expected)


def check_port(option: str, port: str) -> None:
    """Raise InputError for text that names neither a serial device, nor a laser DAC, nor the simulated board."""
    if not split_port(port)[0]:
        dacs = "helios, ether_dream:ADDRESS or idn:ADDRESS for a laser DAC"
        raise InputError(option, port, f"a serial device such as /dev/serial/by-id/..., {SIMULATED}, or {dacs}")


def _list_values(display: NewDisplay, template: Config) -> dict[tuple[str, str], str]:
    """Return the lines that differ from the template's, by section and key."""
    old, limits, power_w = template.display, template.limits, display.power_w
    share = min(1.0, display.pitch_m / FULL_SIZE_PITCH_M)
    energy_j = min(limits.pulse_energy_max_j, power_w * limits.pulse_width_max_s)
    pixel_w = min(limits.pixel_mean_power_max_w, power_w)
    numbers: dict[str, tuple[float, str]] = {
        "display.rows": (display.rows, ""),
        "display.columns": (display.columns, ""),
        "display.pitch_m": (display.pitch_m, ""),
        "display.absorber_width_m": (old.absorber_width_m * share, "along x"),
        "display.absorber_height_m": (old.absorber_height_m * share, "along y"),
        "laser.max_power_w": (power_w, "incident on the pixels at full duty: measure it"),
        "laser.focus_width_m": (template.laser.focus_width_m * share, "along x, on the absorber"),
        "laser.focus_height_m": (template.laser.focus_height_m * share, "along y"),
        "scanner.focal_length_m": (display.focal_length_m, "f-theta lens"),
        "scanner.aim_error_m": (
            template.scanner.aim_error_m * share,
            "largest distance of a settled beam from its target",
        ),
        "limits.pulse_energy_max_j": (energy_j, "largest pulse, at most the longest one at full power"),
        "limits.pixel_mean_power_max_w": (pixel_w, "continuous power on one pixel"),
        "limits.display_mean_power_max_w": (power_w, "continuous power of the diode; lower it for a diode that droops"),
    }
    if display.kpps is not None:
        rated_hz = 1e3 * display.kpps / POINTS_PER_CIRCLE
        numbers["scanner.bandwidth_hz"] = (rated_hz, f"of galvos rated {display.kpps:g} kpps at 8 deg")
    texts = {".name": display.name, "board.transport": split_port(display.port)[0]}
    lines = {place: (json.dumps(value), "") for place, value in texts.items()}
    lines |= {place: (f"{value:.6g}", comment) for place, (value, comment) in numbers.items()}
    found = {}
    for place, (value, comment) in lines.items():
        section, _, key = place.partition(".")
        found[section, key] = f"{key} = {value}" if not comment else f"{key} = {value}".ljust(34) + f"# {comment}"
    return found
