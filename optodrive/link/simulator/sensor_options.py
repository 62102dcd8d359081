"""The simulated board's options for a spot sensor beside it, and what they ask for."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from optodrive.core.errors import InputError
from optodrive.link.simulator.board_limits import BoardSettings
from optodrive.link.simulator.pseudo_terminal import check_link_path

if TYPE_CHECKING:
    from optodrive.link.simulator.bench import SimulatedOptics

DEMO_GEOMETRY = 437
NOISE_MAX_UM = 1e4


def add_sensor_options(parser: argparse.ArgumentParser) -> None:
    """The options that `bench_of` reads."""
    sensor = parser.add_argument_group("a spot sensor beside it, as SENSOR.md says")
    sensor.add_argument("--sensor", type=Path, metavar="LINK", help="link this name to the sensor's pty")
    sensor.add_argument("--geometry", type=int, default=DEMO_GEOMETRY, metavar="SEED", help="what optics is drawn")
    sensor.add_argument("--config", metavar="FILE", help="the display it stands before; a file or a shipped name")
    sensor.add_argument("--sensor-noise-um", type=float, default=10.0, metavar="N", help="one sigma on each axis")
    sensor.add_argument("--false-share", type=float, default=0.02, metavar="N", help="of answers that are reflections")
    sensor.add_argument("--no-readback", action="store_true", help="a galvo driver without position outputs")


def build_optics(options: argparse.Namespace, settings: BoardSettings) -> "SimulatedOptics | None":
    """What the options ask for, None without --sensor; InputError for what they cannot mean."""
    if options.sensor is None:
        return None
    check_link_path("--sensor", options.sensor)
    if not 0.0 <= options.false_share <= 1.0:
        raise InputError("--false-share", options.false_share, "a share, 0 to 1")
    if not 0.0 <= options.sensor_noise_um <= NOISE_MAX_UM:
        raise InputError("--sensor-noise-um", options.sensor_noise_um, f"0 to {NOISE_MAX_UM:g}")
    if options.geometry < 0:
        raise InputError("--geometry", options.geometry, "a seed, 0 or more")
    # Optics and servos are computed with what takes half a second to import; a board without a sensor needs none of it.
    from optodrive.core.units import um_to_m
    from optodrive.device.config import load_config
    from optodrive.link.simulator.bench import SimulatedOptics

    return SimulatedOptics(
        options.sensor,
        load_config(options.config),
        settings,
        options.geometry,
        um_to_m(options.sensor_noise_um),
        options.false_share,
        not options.no_readback,
    )
