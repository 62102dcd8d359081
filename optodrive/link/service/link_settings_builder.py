"""Settings of the link process from a configuration, for the supervisor."""

from dataclasses import replace
from pathlib import Path

from optodrive.device.config import Config
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.service.settings import BoardSettings, LinkSettings
from optodrive.link.session.board_requirements import BoardRequirements
from optodrive.link.session.plan_job import RETIMING_MAX_TICKS


def build_link_settings(config: Config, socket_path: Path, socket_mode: int, capture_path: Path | None) -> LinkSettings:
    """Build the settings of the link process. socket_path: the socket on which it listens; socket_mode: its mode."""
    return LinkSettings(
        boards=build_board_settings(config),
        skew_max_s=config.limits.stage_skew_max_s,
        socket_path=socket_path,
        socket_mode=socket_mode,
        capture_path=capture_path,
        on_web_loss=config.daemon.on_web_loss,
    )


def build_board_settings(config: Config) -> tuple[BoardSettings, ...]:
    """Build the settings of the boards of all stages."""
    if len(config.stages) < 2:
        return (BoardSettings(build_port_settings(config.board), build_board_requirements(config)),)
    return tuple(
        BoardSettings(build_port_settings(one.board), _permit_retiming(build_board_requirements(one)), stage.name)
        for stage, one in zip(config.stages, config.list_stage_configs(), strict=True)
    )


def _permit_retiming(requirements: BoardRequirements) -> BoardRequirements:
    """Let the board accept the shorter pauses of points that follow the host's clock."""
    limits = requirements.limits
    settle_us, rest_us = (max(0, each - RETIMING_MAX_TICKS) for each in (limits.settle_us, limits.rest_us))
    return replace(requirements, limits=replace(limits, settle_us=settle_us, rest_us=rest_us))
