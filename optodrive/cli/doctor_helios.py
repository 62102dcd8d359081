"""Checks of a Helios DAC by its USB protocol.

The DAC is stopped, and its shutter closed.
"""

from typing import Any

from optodrive.cli.doctor_finding import Finding, report_ok, report_problem, report_warning
from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError
from optodrive.core.quantity import format_quantity
from optodrive.device.config import Config
from optodrive.link.helios.dac import Helios
from optodrive.link.helios.encoding import PointScale
from optodrive.link.helios.frames import HOST_LOSS_EMISSION_MAX_S

READY_TRIES = 3
NOT_REPORTED = "interlock, key, emergency stop, laser and executed pulses"


def check_helios(config: Config, clock: Clock, backend: Any = None) -> list[Finding]:
    """Open the configured Helios, read its identity and whether it takes frames. backend: of pyusb, None for libusb."""
    helios = Helios(config.board, clock, backend)
    try:
        with helios:
            findings = [_check_identity(helios, config), _check_readiness(helios)]
    except InputError as error:
        return [report_problem("port", f"{error.where} is {error.value}", f"expected: {error.expected}")]
    except LinkError as error:
        return [report_problem("board", str(error), "unplug it and plug it in again; end other programs that use it")]
    return [*findings, _check_interlock(config), _check_rate(config), _state_limits()]


def _check_identity(helios: Helios, config: Config) -> Finding:
    observation = f"{helios.name}, firmware {helios.version}, stopped, shutter closed"
    if not config.board.uid:
        remedy = f'to accept this one only: board.uid = "{helios.name}"'
        return report_warning("board", f"{observation}; the configuration accepts any Helios", remedy)
    return report_ok("board", observation)


def _check_readiness(helios: Helios) -> Finding:
    if any(helios.is_ready() for _ in range(READY_TRIES)):
        return report_ok("link", "it takes frames")
    return report_problem("link", "it takes no frames after a stop", "unplug it and plug it in again")


def _check_interlock(config: Config) -> Finding:
    if config.board.interlock_watched:
        return report_ok("interlock", "an external one is declared; whether it works cannot be told from here")
    remedy = "board.interlock_watched = true once an external interlock cuts the laser; nothing is emitted before"
    return report_warning("interlock", "none is declared", remedy)


def _check_rate(config: Config) -> Finding:
    point_s = PointScale.from_config(config).point_s
    observation = f"{1.0 / point_s:.1f} points/s for {config.board.points_per_s} requested"
    return report_ok("rate", f"{observation}; a pulse begins and ends up to {format_quantity(point_s, 's')} off")


def _state_limits() -> Finding:
    bound = format_quantity(HOST_LOSS_EMISSION_MAX_S, "s")
    return report_ok("not reported", f"{NOT_REPORTED}; after a killed host it emits for at most {bound}")
