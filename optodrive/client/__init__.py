"""The Python client: `Display`, and `AsyncDisplay` for asyncio, for a running daemon.

A name is imported when it is first used: a command that only arms needs none of them.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from optodrive.client.async_display import AsyncDisplay
    from optodrive.client.display import Display
    from optodrive.client.plan import Plan
    from optodrive.client.stream import AsyncStream, Stream
    from optodrive.daemon.responses.messages import FrameResult
    from optodrive.daemon.responses.state import StateReport

__all__ = ["AsyncDisplay", "AsyncStream", "Display", "FrameResult", "Plan", "StateReport", "Stream"]
_MODULES = {
    "AsyncDisplay": "optodrive.client.async_display",
    "AsyncStream": "optodrive.client.stream",
    "Display": "optodrive.client.display",
    "FrameResult": "optodrive.daemon.responses.messages",
    "Plan": "optodrive.client.plan",
    "StateReport": "optodrive.daemon.responses.state",
    "Stream": "optodrive.client.stream",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
