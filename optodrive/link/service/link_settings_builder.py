"""Settings of the link process from a configuration, for the supervisor."""

from pathlib import Path

from optodrive.device.config import Config
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.service.settings import LinkSettings


def build_link_settings(config: Config, socket_path: Path, socket_mode: int, capture_path: Path | None) -> LinkSettings:
    """Build the settings of the link process. socket_path: the socket on which it listens; socket_mode: its mode."""
    return LinkSettings(
        port=build_port_settings(config.board),
        requirements=build_board_requirements(config),
        socket_path=socket_path,
        socket_mode=socket_mode,
        capture_path=capture_path,
        on_web_loss=config.daemon.on_web_loss,
    )
