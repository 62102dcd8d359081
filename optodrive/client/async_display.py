"""A display, controlled with asyncio: the methods of `Display` as coroutines."""

import asyncio
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self, Unpack

from optodrive.client.async_stream import AsyncStream
from optodrive.client.display import RECONNECT_TIMEOUT_S
from optodrive.client.heights import HeightsLike
from optodrive.client.hold import AsyncHold
from optodrive.client.http import AsyncDaemonClient
from optodrive.client.operations import DisplayOperations, LabelsLike
from optodrive.client.plan import Plan
from optodrive.core.daemon_url import read_default_url
from optodrive.core.errors import OptodriveError
from optodrive.core.types.push_options import Policy, PushOptions
from optodrive.daemon.responses.state import StateReport
from optodrive.device.config import PixelLayout
from optodrive.planning.effective_config import EffectiveConfig
from optodrive.planning.stimuli.pattern import PatternDescription


class AsyncDisplay:
    """A display behind a running daemon, as an asynchronous context manager. See `Display`."""

    def __init__(
        self, url: str | None = None, token: str | None = None, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        self._client = AsyncDaemonClient(url or read_default_url(), token, reconnect_timeout_s)
        self._operations = DisplayOperations(self._client.policy)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._hold: AsyncHold | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._operations.may_emit:
                await asyncio.shield(self.stop())  # a cancelled task must stop what it started, too
        except OptodriveError as stop_error:
            if error is None:
                raise
            error.add_note(f"optodrive: {stop_error}")
        finally:
            await self.close()

    async def close(self) -> None:
        """See `Display.close`."""
        if self._hold is not None:
            await self._hold.close()
        await self._client.close()

    async def arm(self, *, hold: bool = False) -> StateReport:
        """Arm the board as `Display.arm` does. A loop that is blocked for a second disarms, too."""
        if not hold:
            return await self._client.run(self._operations.arm())
        self._record_emission()
        held = AsyncHold(self._client.policy.endpoint)
        await held.open()
        self._hold = held
        return await self.state()

    async def disarm(self) -> StateReport:
        """See `Display.disarm`."""
        return await self._client.run(self._operations.disarm())

    async def dim(self, share: float) -> StateReport:
        """See `Display.dim`."""
        return await self._client.run(self._operations.dim(share))

    async def pause(self) -> StateReport:
        """See `Display.pause`."""
        return await self._client.run(self._operations.pause())

    async def resume(self) -> StateReport:
        """See `Display.resume`."""
        return await self._client.run(self._operations.resume())

    async def stop(self) -> StateReport:
        """See `Display.stop`."""
        return await self._client.run(self._operations.stop())

    async def state(self) -> StateReport:
        """See `Display.state`."""
        return await self._client.run(self._operations.read_state())

    async def config(self) -> EffectiveConfig:
        """See `Display.config`."""
        return await self._client.run(self._operations.read_config())

    async def layout(self) -> PixelLayout:
        """See `Display.layout`."""
        return await self._client.run(self._operations.read_layout())

    async def show(
        self,
        heights_um: HeightsLike,
        duration_s: float = 1.0,
        *,
        simultaneous: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """See `Display.show`."""
        operation = self._operations.show(heights_um, duration_s, simultaneous, options, False, wait, labels)
        return await self._client.run(operation)

    async def push(
        self,
        sequence: Mapping[str, Any],
        *,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """See `Display.push`."""
        return await self._client.run(self._operations.push(sequence, options, False, wait, labels))

    async def play(
        self,
        name: str,
        *,
        dry_run: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **parameters: Any,
    ) -> Plan:
        """See `Display.play`."""
        return await self._client.run(self._operations.play(name, parameters, dry_run, wait, labels))

    async def preview(
        self,
        heights_um: HeightsLike,
        duration_s: float = 1.0,
        *,
        simultaneous: bool = False,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """See `Display.preview`."""
        operation = self._operations.show(heights_um, duration_s, simultaneous, options, True, False)
        return await self._client.run(operation)

    async def patterns(self) -> list[PatternDescription]:
        """See `Display.patterns`."""
        return await self._client.run(self._operations.list_patterns())

    async def plan(self, plan: Plan | str) -> Plan:
        """See `Display.plan`."""
        return await self._client.run(self._operations.read_plan(plan))

    async def cancel(self, plan: Plan | str) -> Plan:
        """See `Display.cancel`."""
        return await self._client.run(self._operations.cancel_plan(plan))

    async def wait(self, plan: Plan | str) -> Plan:
        """See `Display.wait`."""
        return await self._client.run(self._operations.wait_for_plan(plan))

    def stream(self, policy: Policy = "trim") -> AsyncStream:
        """Open a stream as `Display.stream` does: `async with display.stream() as stream: await stream.send(…)`."""
        return AsyncStream(
            self._client.policy.endpoint, self.layout, policy, self._reconnect_timeout_s, self._record_emission
        )

    def _record_emission(self) -> None:
        self._client.require_open()
        self._operations.may_emit = True
