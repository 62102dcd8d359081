"""Command-line options of the simulated spot sensor."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from optodrive.core.errors import InputError
from optodrive.link.simulator.guards import BoardSettings
from optodrive.link.simulator.pseudo_terminal import check_link_path

if TYPE_CHECKING:
    from optodrive.device.config import Config
    from optodrive.link.simulator.simulated_optics import SimulatedOptics
    from optodrive.physics.thermal_state import ThermalState

DEMO_GEOMETRY = 437
NOISE_MAX_UM = 1e4


def add_sensor_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that `build_optics` reads."""
    sensor = parser.add_argument_group("spot sensor, as in SENSOR.md")
    sensor.add_argument("--sensor", type=Path, metavar="LINK", help="link to create to the sensor's pty")
    sensor.add_argument(
        "--geometry", type=int, default=DEMO_GEOMETRY, metavar="SEED", help="seed of the ground-truth optics"
    )
    sensor.add_argument("--config", metavar="FILE", help="display under the beam: a file or a shipped name")
    sensor.add_argument("--stage", metavar="NAME", help="stage whose scanner moves the spot, of several")
    sensor.add_argument("--sensor-noise-um", type=float, default=10.0, metavar="N", help="noise, one sigma per axis")
    sensor.add_argument(
        "--outlier-share",
        type=float,
        default=0.02,
        metavar="N",
        help="share of answers that are outliers (reflections)",
    )
    sensor.add_argument(
        "--truth", metavar="MODEL", help="record pixels of a display with this parameter set: a file or a shipped name"
    )
    sensor.add_argument("--no-readback", action="store_true", help="a galvo driver without position outputs")


def build_optics(options: argparse.Namespace, settings: BoardSettings) -> "SimulatedOptics | None":
    """Build the optics of the options, None without --sensor. Raise InputError for an invalid option."""
    if options.sensor is None:
        return None
    check_link_path("--sensor", options.sensor)
    if not 0.0 <= options.outlier_share <= 1.0:
        raise InputError("--outlier-share", options.outlier_share, "a share, 0 to 1")
    if not 0.0 <= options.sensor_noise_um <= NOISE_MAX_UM:
        raise InputError("--sensor-noise-um", options.sensor_noise_um, f"0 to {NOISE_MAX_UM:g}")
    if options.geometry < 0:
        raise InputError("--geometry", options.geometry, "a seed, 0 or more")
    # These imports take half a second, which a board without a sensor does not need.
    from optodrive.core.quantity import um_to_m
    from optodrive.device.config_file import load_config
    from optodrive.link.simulator.simulated_optics import SimulatedOptics

    config = load_config(options.config).select_stage(options.stage)
    return SimulatedOptics(
        options.sensor,
        config,
        settings,
        options.geometry,
        um_to_m(options.sensor_noise_um),
        options.outlier_share,
        not options.no_readback,
        None if options.truth is None else _build_cold_state(config, options.truth),
    )


def _build_cold_state(config: "Config", truth: str) -> "ThermalState":
    from optodrive.link.simulator.true_display import build_true_display, select_true_terms

    section = config.pixel_model.model_copy(update={"parameters": truth})
    true_config = config.model_copy(update={"pixel_model": section})
    return build_true_display(true_config, None, select_true_terms(true_config, Path(truth))[0])
