"""Reload of the configuration of a running daemon: some keys apply at once, the others after a restart."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from optodrive.core.errors import NotReadyError, OptodriveError
from optodrive.daemon.log import DaemonLog
from optodrive.daemon.notify import Notifier
from optodrive.daemon.one_process.engine import Engine
from optodrive.daemon.web.access_policy import AccessPolicy
from optodrive.daemon.web.tokens import read_private_tokens
from optodrive.daemon.web.web_server import Server
from optodrive.device.config import Config
from optodrive.link.protocol.states import LEASED_STATES
from optodrive.planning.display_model import DisplayModel

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


class ConfigReloader:
    """Handler of SIGHUP from a service manager: reads, validates and applies the configuration."""

    def __init__(
        self,
        config: Config,
        read_config: Callable[[], Config] | None,
        engine: Engine,
        access_policy: AccessPolicy,
        server: Server,
        notifier: Notifier,
        log: DaemonLog,
    ) -> None:
        self._running = config
        self._read_config = read_config
        self._engine = engine
        self._access_policy = access_policy
        self._server = server
        self._notifier = notifier
        self._log = log

    def request_reload(self, *_: object) -> None:
        """Schedule a reload in the web server's loop. Do nothing before that loop runs."""
        if self._server.loop is not None:
            self._server.loop.call_soon_threadsafe(self._reload)

    def _reload(self) -> None:
        self._notifier.notify_reloading()
        try:
            self._log.write(self._apply(), "notice", EVENT="reloaded")
        except OptodriveError as error:
            self._log.write(f"not reloaded, nothing changed: {error}", "err", EVENT="reload-refused")
        finally:
            self._notifier.send("READY=1")

    def _apply(self) -> str:
        assert self._read_config is not None  # noqa: S101 - without it the signal ends the daemon
        require_disarmed(self._engine.board_state)
        new = self._read_config()
        DisplayModel.from_config(new)  # validates the sections against each other, as at startup
        reloaded, waiting = split_changed_keys(self._running, new)
        self._running = merge_reloadable(self._running, new)
        daemon = self._running.daemon
        file = Path(daemon.tokens) if daemon.tokens else None
        tokens = self._access_policy.tokens if file is None else read_private_tokens(file)
        self._access_policy.update(tokens, daemon)
        if self._access_policy.audit is not None:
            self._access_policy.audit.record({"event": "reloaded", "applied": reloaded, "waiting": waiting})
        return describe_reload(reloaded, waiting, file)
