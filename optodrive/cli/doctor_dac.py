"""Checks of a laser DAC by its own protocol.

The DAC is stopped, and its light switched off.
"""

from optodrive.cli.doctor_board import check_heat
from optodrive.cli.output import Finding, report_ok, report_problem, report_warning
from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError
from optodrive.core.quantity import format_quantity
from optodrive.device.config import Config
from optodrive.link.dac.encoding import PointScale
from optodrive.link.dac.laser_dac import LaserDac
from optodrive.link.dac.registry import build_dac

READY_TRIES = 3
NOT_REPORTED = "interlock, key, emergency stop, laser and executed pulses"
RECONNECT = "unplug it and plug it in again"


def check_dac(config: Config, clock: Clock) -> list[Finding]:
    """Open the configured DAC, read its identity and whether it takes points."""
    dac = build_dac(config.board, clock)
    try:
        with dac:
            identity = dac.find_uid()
            findings = [_check_identity(dac, config), _check_readiness(dac)]
        findings.append(check_heat(dac.transport, identity, config, clock))
    except InputError as error:
        return [report_problem("port", f"{error.where} is {error.value}", f"expected: {error.expected}")]
    except LinkError as error:
        return [report_problem("board", str(error), f"{RECONNECT}; end other programs that use it")]
    return [*findings, _check_interlock(config), _check_rate(config), _state_limits(dac)]


def _check_identity(dac: LaserDac, config: Config) -> Finding:
    observation = f"{dac.name}, firmware {dac.firmware}, stopped, its light off"
    if not config.board.uid:
        remedy = f'to accept this one only: uid = "{dac.name}" in section [board]'
        return report_warning("board", f"{observation}; the configuration accepts any {dac.format.label}", remedy)
    return report_ok("board", observation)


def _check_readiness(dac: LaserDac) -> Finding:
    if any(dac.is_ready() for _ in range(READY_TRIES)):
        return report_ok("link", "it takes points")
    return report_problem("link", "it takes no points after a stop", RECONNECT)


def _check_interlock(config: Config) -> Finding:
    if config.board.interlock_watched:
        return report_ok("interlock", "an external one is declared; whether it works cannot be told from here")
    remedy = "board.interlock_watched = true once an external interlock cuts the laser; nothing is emitted before"
    return report_warning("interlock", "none is declared", remedy)


def _check_rate(config: Config) -> Finding:
    scale = PointScale.from_config(config)
    point_s, stretch = scale.point_s, scale.format.stretch
    observation = f"{1.0 / point_s:.1f} points/s for {config.board.points_per_s} requested"
    longer = f", and lasts up to {100.0 * (stretch - 1.0):.2g} % longer at less power" if stretch > 1.0 else ""
    return report_ok(
        "rate", f"{observation}; a pulse begins and ends up to {format_quantity(point_s, 's')} off{longer}"
    )


def _state_limits(dac: LaserDac) -> Finding:
    bound = format_quantity(dac.format.host_loss_max_s, "s")
    return report_ok("not reported", f"{NOT_REPORTED}; after a killed host it emits for at most {bound}")
