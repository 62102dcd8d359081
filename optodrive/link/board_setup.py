"""Port settings and board requirements of a configuration, as the plain numbers that the link works with."""

from dataclasses import asdict, fields, replace
from math import ceil
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.laser_power import find_proportion_excess, find_proportional_power_w
from optodrive.core.types.arrays import IntArray
from optodrive.device.config import Config
from optodrive.device.field_loader import build_settling_table, load_scan_field
from optodrive.device.pixel_map import build_aim_layout
from optodrive.device.scan_field import list_adjacent_pixels
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.quantisation import CENTRE_CODE, CODE_MAX, WireScale
from optodrive.link.service.settings import BoardSettings, LinkSettings
from optodrive.link.session.arming import TICK_HZ, BoardRequirements, ConfiguredValues
from optodrive.link.session.plan_job import RETIMING_MAX_TICKS
from optodrive.link.transport.base import PortSettings

CAP_MARGIN = 1.05
"""Ratio of the board's caps to the limiter's. The board is the second line of defence behind the limiter."""
FIELD_MARGIN_CODES = 64
SIMULATED_CELL_MAX_CODES = 1300
"""Size of the spot guards' cells on a simulated board whose pixels do not need smaller ones."""
SIMULATED_CELLS = 2048
"""Number of cells for which a simulated board has accounts if the display does not need more."""
WIRE_MAX = 0xFFFF
"""Largest number that the message of limits holds for the settling, 16 bits."""
MIRROR_RANGE = ("x_min", "x_max", "y_min", "y_max")


def build_port_settings(config: Config) -> PortSettings:
    """Return the address of the board of a configuration with one stage.

    A board in software is built for the display: its own limits are those that the display requires, and no pixel
    shares a cell of its spot guards with another. Its range of the mirrors is that of the scanner. Raise InputError for
    trajectories that no board has.
    """
    board, own_settings = config.board, dict[str, int | str]()
    if config.scanner.trajectories == "early_steps":
        raise InputError("scanner.trajectories", "early_steps", "'steps': only `optodrive dac play` sends steps early")
    if board.transport == "simulated" or board.is_dac:
        requirements = build_board_requirements(config)
        limits = permit_retiming(requirements.limits)
        own_settings = {name: value for name, value in asdict(limits).items() if name not in MIRROR_RANGE}
        own_settings["cell_codes"] = min(SIMULATED_CELL_MAX_CODES, requirements.cell_max_codes)
        own_settings["interface"] = config.scanner.interface
        own_settings["feedback_codes"] = requirements.feedback_codes
        own_settings["cells"] = max(SIMULATED_CELLS, requirements.pixels)
    address = {field.name: getattr(board, field.name) for field in fields(PortSettings) if hasattr(board, field.name)}
    if not board.is_dac:
        address["interlock_watched"] = None
    return PortSettings(**address, own_settings=own_settings, curve=config.laser.curve)


def permit_retiming(limits: m.Limits) -> m.Limits:
    """Return limits with the shorter pauses of points that follow the host's clock."""
    settle_us, rest_us = (max(0, each - RETIMING_MAX_TICKS) for each in (limits.settle_us, limits.rest_us))
    return replace(limits, settle_us=settle_us, rest_us=rest_us)


def build_scales(config: Config) -> tuple[WireScale, ...]:
    """Return the scale factors of the board of each stage. The DAC codes span the whole range of the scanner."""
    return tuple(
        WireScale(
            rad_per_code=stage.scanner.range_rad / (CODE_MAX - CENTRE_CODE),
            full_power_w=stage.laser.max_power_w,
            tick_s=1.0 / TICK_HZ,
            curve=stage.laser.curve,
            min_power_w=stage.min_power_w,
            **stage.scanner.wiring._asdict(),
        )
        for stage in config.list_stage_configs()
    )


def build_board_requirements(config: Config, margin_codes: int = FIELD_MARGIN_CODES) -> BoardRequirements:
    """Derive the requirements of a configuration with one stage.

    margin_codes: DAC codes by which the permitted range extends beyond the outermost pixels
    """
    (scale,), laser = build_scales(config), config.laser
    layout = build_aim_layout(config)
    angles_rad = load_scan_field(config).angles_rad(layout.x_m, layout.y_m)
    codes = np.stack(scale.to_outputs(*(scale.to_codes(angle_rad) for angle_rad in angles_rad)))
    return BoardRequirements(
        limits=_build_limits(config, scale, codes, margin_codes),
        cell_max_codes=_compute_cell_max(codes, list_adjacent_pixels(layout), scale, config),
        pixels=len(layout),
        scale=scale,
        lease_s=config.board.lease_s,
        baud=config.board.baud,
        uid="" if config.board.is_dac else config.board.uid,  # a DAC's driver compares it
        interface=config.scanner.interface,
        feedback=config.scanner.feedback,
        values=ConfiguredValues(
            pitch_m=config.display.pitch_m,
            bandwidth_hz=config.scanner.bandwidth_hz,
            slew_rad_per_s=config.scanner.slew_rad_per_s,
            pulse_width_max_s=config.limits.pulse_width_max_s,
            full_power_w=find_proportional_power_w(laser.max_power_w, laser.curve),
            pulse_energy_max_j=config.limits.pulse_energy_max_j,
            pixel_mean_power_max_w=config.limits.pixel_mean_power_max_w,
            modulation=laser.modulation,
            whole_periods=laser.whole_periods,
        ),
    )


def build_bench_requirements(config: Config, margin_m: float) -> BoardRequirements:
    """Derive the requirements of a task that moves the mirrors around the centre, too, where there may be no pixel.

    margin_m: distance by which the permitted range extends beyond the centre and the outermost pixels, m
    """
    margin_codes = ceil(margin_m / (2.0 * config.scanner.focal_length_m * config.scanner.rad_per_code))
    requirements = build_board_requirements(config, margin_codes)
    limits = requirements.limits
    low, high = max(0, CENTRE_CODE - margin_codes), min(CODE_MAX, CENTRE_CODE + margin_codes)
    limits = replace(
        limits,
        x_min=min(limits.x_min, low),
        x_max=max(limits.x_max, high),
        y_min=min(limits.y_min, low),
        y_max=max(limits.y_max, high),
    )
    return replace(requirements, limits=limits)


def _compute_cell_max(codes: IntArray, adjacent: IntArray, scale: WireScale, config: Config) -> int:
    """Return the largest cell of the board's spot guards that no two pixels share, in codes.

    codes: [2, p] of the outputs for the pixels; adjacent: [2, n] pairs of adjacent ones. Pixels a whole cell apart
    along one axis share none.
    """
    one, other = adjacent
    if codes.shape[1] == 1:
        return CODE_MAX
    if not len(one):  # two pitches apart or more
        return int(config.display.pitch_m / (2.0 * config.scanner.focal_length_m * scale.rad_per_code))
    return int(np.abs(codes[:, one] - codes[:, other]).max(axis=0).min())


def _build_limits(config: Config, scale: WireScale, codes: IntArray, margin_codes: int) -> m.Limits:
    limits, (x_codes, y_codes) = config.limits, codes
    laser = config.laser
    # The board counts energy in proportion to the duty, and no less than is emitted: of a laser with a curve too much
    # at some duties, for which its caps leave room.
    margin = CAP_MARGIN * find_proportion_excess(laser.max_power_w, laser.curve, config.min_power_w)
    settle_us, settle_ns_per_code = _compute_settling(config, scale)
    return m.Limits(
        max_on_us=ceil(limits.pulse_width_max_s * 1e6),
        max_duty=65535,
        mean_duty=65535,
        spot_uj=ceil(limits.pulse_energy_max_j * 1e6 * margin),
        spot_leak_uw=ceil(limits.pixel_mean_power_max_w * 1e6 * margin),
        full_power_uw=round(find_proportional_power_w(laser.max_power_w, laser.curve) * 1e6),
        x_min=max(0, int(x_codes.min()) - margin_codes),
        x_max=min(CODE_MAX, int(x_codes.max()) + margin_codes),
        y_min=max(0, int(y_codes.min()) - margin_codes),
        y_max=min(CODE_MAX, int(y_codes.max()) + margin_codes),
        settle_us=settle_us,
        settle_ns_per_code=settle_ns_per_code,
        rest_us=round(limits.pulse_gap_min_s * 1e6),
        lease_ms=round(config.board.lease_s * 1e3),
    )


def _compute_settling(config: Config, scale: WireScale) -> tuple[int, int]:
    """Return settle_us and settle_ns_per_code, a line that nowhere exceeds the planned settling time.

    Its slope is the slew rate, or less where the slew decides alone and leaves no time to start with. The planned time
    jumps where longer moves start to overshoot, so a steeper line would have to start lower for short moves.
    """
    settling_table = build_settling_table(config)
    ns_per_code = min(WIRE_MAX, int(scale.rad_per_code / config.scanner.slew_rad_per_s * 1e9))
    pitches = np.arange(1, len(settling_table.after_long_dwell[0]))
    # Quantisation may lengthen a move by one code.
    codes = np.floor(pitches * settling_table.pitch_rad / scale.rad_per_code).astype(np.int64) + 2
    times_us = np.minimum(*(np.array(table)[pitches] for table in settling_table.after_long_dwell))
    settle_us = int((times_us + -codes * ns_per_code // 1000).min())
    if settle_us < RETIMING_MAX_TICKS:
        settle_us = min(RETIMING_MAX_TICKS, int(times_us.min()))
        ns_per_code = int(((times_us - settle_us) * 1000 // codes).min())
    return min(WIRE_MAX, settle_us), ns_per_code


def build_link_settings(config: Config, socket_path: Path, socket_mode: int, capture_path: Path | None) -> LinkSettings:
    """Build the settings of the link process.

    socket_path: the socket on which it listens; socket_mode: its mode
    """
    return LinkSettings(
        boards=build_board_settings(config),
        skew_max_s=config.limits.stage_skew_max_s,
        socket_path=socket_path,
        socket_mode=socket_mode,
        capture_path=capture_path,
        on_web_loss=config.daemon.on_web_loss,
        on_stage_loss=config.daemon.on_stage_loss,
    )


def build_board_settings(config: Config) -> tuple[BoardSettings, ...]:
    """Build the settings of the boards of all stages."""
    if len(config.stages) < 2:
        return (BoardSettings(build_port_settings(config), build_board_requirements(config)),)
    settings = []
    for stage, one in zip(config.stages, config.list_stage_configs(), strict=True):
        requirements = build_board_requirements(one)
        requirements = replace(requirements, limits=permit_retiming(requirements.limits))
        settings.append(BoardSettings(build_port_settings(one), requirements, stage.name))
    return tuple(settings)
