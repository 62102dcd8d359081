"""The driver from Python: `Display`, and `AsyncDisplay` for asyncio, over a running daemon (docs/how-to/use-the-python-client.md)."""

from optodrive.client.answers import FrameResult, Plan, State
from optodrive.client.async_display import AsyncDisplay, AsyncStream
from optodrive.client.display import Display
from optodrive.client.stream import Stream

__all__ = ["AsyncDisplay", "AsyncStream", "Display", "FrameResult", "Plan", "State", "Stream"]
