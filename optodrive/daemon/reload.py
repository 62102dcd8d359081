"""A new configuration for a daemon that runs: what can be taken at once, and what waits for a restart."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from optodrive.core.errors import NotReadyError, OptodriveError
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.log import Log
from optodrive.daemon.notify import Notifier
from optodrive.daemon.web.access_policy import Door
from optodrive.daemon.web.tokens import private_tokens
from optodrive.daemon.web.web_server import Server
from optodrive.device.config import Config
from optodrive.planning.pipeline import Display

TAKEN_AT_ONCE = ("hosts", "body_max_bytes", "requests_per_s", "requests_burst")
"""Keys of [daemon]; the file of tokens is read again too."""
NOT_WHILE = ("ARMING", "ARMED", "RUNNING", "HOLD")


def require_dark(board_state: str) -> None:
    """NotReadyError while the board may emit: what it runs under stays as it was when it was armed."""
    if board_state in NOT_WHILE:
        raise NotReadyError(f"nothing is reloaded while the board is {board_state}; disarm it first")


def changed(running: Config, new: Config) -> tuple[list[str], list[str]]:
    """Keys that differ: those that are taken at once, and those that wait for a restart."""
    keys = _differing(running.model_dump(), new.model_dump(), "")
    at_once = [key for key in keys if key in {f"daemon.{name}" for name in TAKEN_AT_ONCE}]
    return at_once, [key for key in keys if key not in at_once]


def taken(running: Config, new: Config) -> Config:
    """The configuration that runs, with what is taken at once from the new one."""
    daemon = running.daemon.model_copy(update={name: getattr(new.daemon, name) for name in TAKEN_AT_ONCE})
    return running.model_copy(update={"daemon": daemon})


def sentence(at_once: list[str], waiting: list[str], tokens_file: Path | None) -> str:
    """What a reload did, in one line."""
    parts = [f"taken: {', '.join(at_once)}" if at_once else "nothing to be taken at once"]
    if tokens_file is not None:
        parts.append(f"tokens read again from {tokens_file}")
    if waiting:
        parts.append(f"WAITING FOR A RESTART: {', '.join(waiting)}")
    return "reloaded; " + "; ".join(parts)


def _differing(old: dict[str, Any], new: dict[str, Any], under: str) -> list[str]:
    keys = []
    for key in sorted({*old, *new}):
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            keys += _differing(before, after, f"{under}{key}.")
        elif before != after:
            keys.append(under + key)
    return keys


class Reloading:
    """SIGHUP from a service manager: the configuration is read again, checked whole, and taken as far as can be."""

    def __init__(
        self,
        config: Config,
        again: Callable[[], Config] | None,
        engine: Engine,
        door: Door,
        server: Server,
        notifier: Notifier,
        log: Log,
    ) -> None:
        self._running = config
        self._again = again
        self._engine = engine
        self._door = door
        self._server = server
        self._notifier = notifier
        self._log = log

    def asked_for(self, *_: object) -> None:
        """Reload soon, between two callbacks of the web server's loop; before that runs there is nothing to reload."""
        if self._server.loop is not None:
            self._server.loop.call_soon_threadsafe(self._reload)

    def _reload(self) -> None:
        self._notifier.reloading()
        try:
            self._log.say(self._take(), "notice", EVENT="reloaded")
        except OptodriveError as error:
            self._log.say(f"not reloaded, all stays as it was: {error}", "err", EVENT="reload-refused")
        finally:
            self._notifier.tell("READY=1")

    def _take(self) -> str:
        assert self._again is not None  # noqa: S101 - else the signal ends the daemon
        require_dark(self._engine.board_state)
        new = self._again()
        Display.of(new)  # finds what is wrong between the sections, as at a start
        at_once, waiting = changed(self._running, new)
        self._running = taken(self._running, new)
        daemon = self._running.daemon
        file = Path(daemon.tokens) if daemon.tokens else None
        tokens = self._door.tokens if file is None else private_tokens(file)
        self._door.take(tokens, daemon)
        self._server.config.ws_max_size = daemon.body_max_bytes
        if self._door.audit is not None:
            self._door.audit.note({"event": "reloaded", "taken": at_once, "waiting": waiting})
        return sentence(at_once, waiting, file)
