"""Reload of the configuration of a running daemon: some keys apply at once, the others after a restart."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optodrive.core.errors import NotReadyError
from optodrive.daemon.web.tokens import Tokens, read_private_tokens
from optodrive.device.config import Config, DaemonSection
from optodrive.link.protocol.states import LEASED_STATES

RELOADABLE_KEYS = ("hosts", "body_max_bytes", "requests_per_s", "requests_burst")
"""Keys of [daemon] that apply at once. The tokens file is also read again."""


def require_disarmed(board_state: str) -> None:
    """Raise NotReadyError while the board may emit, because an armed board keeps the configuration of its arming."""
    if board_state in LEASED_STATES:
        raise NotReadyError(f"no reload while the board is {board_state}; disarm it first")


def split_changed_keys(running: Config, new: Config) -> tuple[list[str], list[str]]:
    """Return the changed keys: those that apply at once, and those that need a restart."""
    keys = _find_differences(running.model_dump(), new.model_dump(), "")
    reloaded = [key for key in keys if key in {f"daemon.{name}" for name in RELOADABLE_KEYS}]
    return reloaded, [key for key in keys if key not in reloaded]


def merge_reloadable(running: Config, new: Config) -> Config:
    """Return the running configuration with the reloadable keys of the new one."""
    daemon = running.daemon.model_copy(update={name: getattr(new.daemon, name) for name in RELOADABLE_KEYS})
    return running.model_copy(update={"daemon": daemon})


def describe_reload(reloaded: list[str], waiting: list[str], tokens_file: Path | None) -> str:
    """Return the effect of a reload in one line."""
    parts = [f"applied: {', '.join(reloaded)}" if reloaded else "nothing to apply at once"]
    if tokens_file is not None:
        parts.append(f"tokens read from {tokens_file}")
    if waiting:
        parts.append(f"RESTART REQUIRED FOR: {', '.join(waiting)}")
    return "reloaded; " + "; ".join(parts)


def _find_differences(old: dict[str, Any], new: dict[str, Any], prefix: str) -> list[str]:
    keys = []
    for key in sorted({*old, *new}):
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            keys += _find_differences(before, after, f"{prefix}{key}.")
        elif before != after:
            keys.append(prefix + key)
    return keys


@dataclass(frozen=True)
class ReloadResult:
    """What a reload changed: the section of the web process, its tokens, the keys and the line for the log."""

    daemon: DaemonSection
    tokens: Tokens
    reloaded: list[str]
    waiting: list[str]
    line: str

    def build_web_message(self, number: int) -> dict[str, Any]:
        """Return the control message for the web process, which answers with its number."""
        return {
            "kind": "reload",
            "id": number,
            "daemon": {name: getattr(self.daemon, name) for name in RELOADABLE_KEYS},
            "tokens": [[token.name, token.role, token.secret] for token in self.tokens.all],
            "fields": {"event": "reloaded", "applied": self.reloaded, "waiting": self.waiting},
        }


class ConfigReloader:
    """Reads and validates the configuration again.

    config, tokens: those in use; read_config: reads the configuration
    """

    def __init__(self, config: Config, tokens: Tokens, read_config: Callable[[], Config]) -> None:
        self.config = config
        self.tokens = tokens
        self._read_config = read_config

    def reload(self, board_state: str) -> ReloadResult:
        """Return what changes, and use it from now on. Raise an OptodriveError and change nothing if it must not."""
        from optodrive.planning.display_model import DisplayModel

        require_disarmed(board_state)
        new = self._read_config()
        DisplayModel.from_config(new)  # validates the sections against each other, as at startup
        reloaded, waiting = split_changed_keys(self.config, new)
        running = merge_reloadable(self.config, new)
        file = Path(running.daemon.tokens) if running.daemon.tokens else None
        tokens = self.tokens if file is None else read_private_tokens(file)
        self.config, self.tokens = running, tokens
        return ReloadResult(running.daemon, tokens, reloaded, waiting, describe_reload(reloaded, waiting, file))
