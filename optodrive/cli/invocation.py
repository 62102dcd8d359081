"""The command line by which a command was called."""

from typing import Any, NamedTuple


class Invocation(NamedTuple):
    """The command line of a command.

    stopped: result of the link process if STOP was sent before the command was imported
    """

    arguments: tuple[str, ...]
    stopped: dict[str, Any] | None
