"""The Python client: `Display`, and `AsyncDisplay` for asyncio, for a running daemon."""

from optodrive.client.async_display import AsyncDisplay
from optodrive.client.async_stream import AsyncStream
from optodrive.client.display import Display
from optodrive.client.plan import Plan
from optodrive.client.stream import Stream
from optodrive.daemon.responses.state import StateReport
from optodrive.daemon.responses.stream import FrameResult

__all__ = ["AsyncDisplay", "AsyncStream", "Display", "FrameResult", "Plan", "StateReport", "Stream"]
