"""Settings of the link process from a configuration, for the supervisor."""

from dataclasses import replace
from pathlib import Path

from optodrive.device.config import Config
from optodrive.link.board_setup import build_board_requirements, build_port_settings, permit_retiming
from optodrive.link.service.settings import BoardSettings, LinkSettings


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
