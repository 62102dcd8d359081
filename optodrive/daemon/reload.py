"""Reload of the configuration of a running daemon: some keys apply at once, the others after a restart."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optodrive.core.errors import NotReadyError
from optodrive.daemon.api.tokens import Token, Tokens, read_private_tokens
from optodrive.device.config import Config
from optodrive.device.config_sections import DaemonSection
from optodrive.link.protocol.states import LEASED_STATES

RELOADABLE_KEYS = ("hosts", "body_max_bytes", "requests_per_s", "requests_burst")
"""Keys of [daemon] that apply at once. The tokens file is also read again."""


def split_changed_keys(running: Config, new: Config) -> tuple[list[str], list[str]]:
    """Return the changed keys: those that apply at once, and those that need a restart."""
    keys = _find_differences(running.model_dump(), new.model_dump(), "")
    reloaded = [key for key in keys if key in {f"daemon.{name}" for name in RELOADABLE_KEYS}]
    return reloaded, [key for key in keys if key not in reloaded]


def merge_reloadable(running: Config, new: Config) -> Config:
    """Return the running configuration with the reloadable keys of the new one."""
    daemon = running.daemon.model_copy(update={name: getattr(new.daemon, name) for name in RELOADABLE_KEYS})
    return running.model_copy(update={"daemon": daemon})


def describe_reload(
    reloaded: list[str], waiting: list[str], tokens_file: Path | None, revoked: Sequence[Token] = ()
) -> str:
    """Return the effect of a reload in one line."""
    parts = [f"applied: {', '.join(reloaded)}" if reloaded else "nothing to apply at once"]
    if revoked:
        parts.append(f"tokens revoked: {_list_names(revoked)}")
    if tokens_file is not None:
        parts.append(f"tokens read from {tokens_file}")
    if waiting:
        parts.append(f"RESTART REQUIRED FOR: {', '.join(waiting)}")
    return "reloaded; " + "; ".join(parts)


def _list_names(tokens: Sequence[Token]) -> str:
    return ", ".join(token.name for token in tokens)


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
    """Result of a reload: the section of the web process, its tokens, the keys and the line for the log.

    revoked: tokens that are no longer valid
    """

    daemon: DaemonSection
    tokens: Tokens
    revoked: Sequence[Token]
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
            "fields": {
                "event": "reloaded",
                "applied": self.reloaded,
                "waiting": self.waiting,
                "revoked": [token.name for token in self.revoked],
            },
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
        """Apply the changes and return them. Raise an OptodriveError and change nothing if they must not be applied.

        While the board may emit, tokens can be revoked, which can only make it darker; everything else must wait,
        because an armed board keeps the configuration of its arming.
        """
        from optodrive.planning.display_model import DisplayModel

        if board_state in LEASED_STATES:
            return self._revoke_only(board_state)
        new = self._read_config()
        DisplayModel.from_config(new)  # validates the sections against each other, as at startup
        reloaded, waiting = split_changed_keys(self.config, new)
        running = merge_reloadable(self.config, new)
        file = Path(running.daemon.tokens) if running.daemon.tokens else None
        tokens = self.tokens if file is None else read_private_tokens(file)
        revoked = self.tokens.find_revoked(tokens)
        self.config, self.tokens = running, tokens
        line = describe_reload(reloaded, waiting, file, revoked)
        return ReloadResult(running.daemon, tokens, revoked, reloaded, waiting, line)

    def _revoke_only(self, board_state: str) -> ReloadResult:
        """Read the tokens again, and keep those in use that are unchanged. Raise NotReadyError if that is all."""
        daemon = self.config.daemon
        new = read_private_tokens(Path(daemon.tokens)) if daemon.tokens else self.tokens
        revoked = self.tokens.find_revoked(new)
        if not revoked:
            raise NotReadyError(f"no reload while the board is {board_state}, except to revoke tokens; disarm it first")
        self.tokens = Tokens(token for token in self.tokens.all if token not in revoked)
        line = f"tokens revoked: {_list_names(revoked)}; the rest waits for a reload while the board is disarmed"
        return ReloadResult(daemon, self.tokens, revoked, [], [], line)
