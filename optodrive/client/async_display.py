"""A display, driven from asyncio: as `Display`, with `await`."""

import asyncio
import time
from collections.abc import Mapping
from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Self

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from optodrive.client.answers import FrameResult, Plan, State
from optodrive.client.display import PATIENCE_S, POLL_S
from optodrive.client.heights import Heights, by_pixel, layout_of, to_bytes
from optodrive.client.http import DEFAULT_URL, RETRY_S, Access, Answer, AsyncRemote
from optodrive.client.requests import Fit, Order, Policy, frame_body, plan_path, play_order, push_order
from optodrive.client.stream import ANSWER_TIMEOUT_S, BROKEN, OPEN_TIMEOUT_S, Results, raised, refusal, socket_url
from optodrive.core.errors import LinkError, OptodriveError
from optodrive.device.config import PixelLayout


class AsyncDisplay:
    """A display behind a running daemon, for `async with`; what is said of `Display` holds here."""

    def __init__(self, url: str = DEFAULT_URL, token: str | None = None, patience_s: float = PATIENCE_S) -> None:
        self._remote = AsyncRemote(url, token, patience_s)
        self._patience_s = patience_s
        self._layout: PixelLayout | None = None
        self._may_be_lit = False

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._may_be_lit:
                await asyncio.shield(self.stop())  # a task that is cancelled stops what it lit all the same
        except OptodriveError as trouble:
            if error is None:
                raise
            error.add_note(f"optodrive: {trouble}")
        finally:
            await self.close()

    async def close(self) -> None:
        """Close the connections, and stop nothing."""
        await self._remote.close()

    async def arm(self) -> State:
        """As `Display.arm`."""
        self._may_be_lit = True
        return State.of(await self._remote.call("POST", "/v1/arm"))

    async def disarm(self) -> State:
        """As `Display.disarm`."""
        return State.of(await self._remote.call("POST", "/v1/disarm"))

    async def stop(self) -> State:
        """As `Display.stop`."""
        state = State.of(await self._remote.stop())
        self._may_be_lit = False
        return state

    async def state(self) -> State:
        """As `Display.state`."""
        return State.of(await self._remote.call("GET", "/v1/state"))

    async def config(self) -> Answer:
        """As `Display.config`."""
        return await self._remote.call("GET", "/v1/config")

    async def layout(self) -> PixelLayout:
        """As `Display.layout`."""
        if self._layout is None:
            self._layout = layout_of(await self.config())
        return self._layout

    async def show(
        self,
        heights_um: Heights,
        duration_s: float = 1.0,
        *,
        together: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
        wait: bool = True,
    ) -> Plan:
        """As `Display.show`."""
        body = frame_body(by_pixel(heights_um, await self.layout()), duration_s, together)
        return await self.push(body, policy=policy, fit=fit, wait=wait)

    async def push(
        self, sequence: Mapping[str, Any], *, policy: Policy = "trim", fit: Fit = "as_is", wait: bool = True
    ) -> Plan:
        """As `Display.push`."""
        return await self._shown(push_order(sequence, policy, fit, dry_run=False), wait)

    async def play(
        self,
        name: str,
        *,
        policy: Policy = "trim",
        fit: Fit = "as_is",
        dry_run: bool = False,
        wait: bool = True,
        **parameters: Any,
    ) -> Plan:
        """As `Display.play`."""
        order = play_order(name, parameters, policy, fit, dry_run)
        return await self._planned(order) if dry_run else await self._shown(order, wait)

    async def preview(
        self,
        heights_um: Heights,
        duration_s: float = 1.0,
        *,
        together: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
    ) -> Plan:
        """As `Display.preview`."""
        body = frame_body(by_pixel(heights_um, await self.layout()), duration_s, together)
        return await self._planned(push_order(body, policy, fit, dry_run=True))

    async def patterns(self) -> list[dict[str, Any]]:
        """As `Display.patterns`."""
        found: list[dict[str, Any]] = (await self._remote.call("GET", "/v1/patterns"))["patterns"]
        return found

    async def plan(self, plan: Plan | str) -> Plan:
        """As `Display.plan`."""
        return Plan.of(await self._remote.call("GET", plan_path(_id(plan))), await self.layout())

    async def cancel(self, plan: Plan | str) -> Plan:
        """As `Display.cancel`."""
        return Plan.of(await self._remote.call("DELETE", plan_path(_id(plan))), await self.layout())

    async def wait(self, plan: Plan | str) -> Plan:
        """As `Display.wait`."""
        path = plan_path(_id(plan))
        while (await self._remote.call("GET", path, params={"pulses": False}))["status"] in ("queued", "running"):
            await asyncio.sleep(POLL_S)
        return (await self.plan(plan)).checked()

    def stream(self, policy: Policy = "trim") -> "AsyncStream":
        """As `Display.stream`: `async with display.stream() as stream: await stream.send(heights_um)`."""
        return AsyncStream(self, policy)

    async def _planned(self, order: Order) -> Plan:
        answer = await self._remote.call(order.method, order.path, order.safe, **order.request)
        return Plan.of(answer, await self.layout())

    async def _shown(self, order: Order, wait: bool) -> Plan:
        self._may_be_lit = True
        plan = await self._planned(order)
        return await self.wait(plan) if wait else plan


class AsyncStream:
    """An open stream, once entered; as `Stream`."""

    def __init__(self, display: AsyncDisplay, policy: Policy) -> None:
        self._display = display
        self._access: Access = display._remote.access
        self._url = socket_url(self._access, policy)
        self._number = 0
        self._results = Results()
        self._news = asyncio.Condition()
        self._lost = 0
        self._open = AsyncExitStack()
        self._link: ClientConnection | None = None
        self._reader: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        await self._connect()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """As `Stream.close`."""
        await self._open.aclose()
        if self._reader is not None:
            await asyncio.gather(self._reader, return_exceptions=True)

    async def send(self, heights_um: Heights) -> int:
        """As `Stream.send`."""
        number, self._number = self._number, self._number + 1
        frame = to_bytes(number, by_pixel(heights_um, await self._display.layout()))
        self._display._may_be_lit = True
        until_s = time.monotonic() + self._display._patience_s
        while True:
            try:
                if self._link is not None:
                    await self._link.send(frame)
                    return number
            except ConnectionClosed:
                self._link = None
            try:
                await self._connect()
            except LinkError:
                if time.monotonic() >= until_s:
                    raise
                await asyncio.sleep(RETRY_S)

    async def results(self) -> list[FrameResult]:
        """As `Stream.results`."""
        async with self._news:
            return self._results.drained()

    async def wait(self, frame: int | None = None, timeout_s: float = ANSWER_TIMEOUT_S) -> FrameResult:
        """As `Stream.wait`."""
        number = self._number - 1 if frame is None else frame
        try:
            async with asyncio.timeout(timeout_s), self._news:
                while (found := self._results.final(number)) is None:
                    if number < self._lost:
                        raise LinkError(f"the link broke before it was heard what became of frame {number}")
                    await self._news.wait()
        except TimeoutError:
            raise LinkError(f"nothing was heard of frame {number} for {timeout_s:g} s") from None
        return raised(found)

    async def _connect(self) -> None:
        try:
            self._link = await self._opened()
        except InvalidStatus as error:
            if error.response.status_code != 401 or not self._access.renewed():
                raise refusal(error) from None
            self._link = await self._opened()
        except BROKEN as error:
            raise self._access.unreachable(error) from None
        self._reader = asyncio.create_task(self._read(self._link))

    async def _opened(self) -> ClientConnection:
        await self._open.aclose()
        link = connect(
            self._url,
            additional_headers=self._access.headers,
            sock=self._access.socket(),
            proxy=None,
            open_timeout=OPEN_TIMEOUT_S,
            compression=None,
        )
        return await self._open.enter_async_context(link)

    async def _read(self, link: ClientConnection) -> None:
        try:
            async for message in link:
                async with self._news:
                    self._results.take_in(message)
                    self._news.notify_all()
        except ConnectionClosed:
            pass  # found out, and mended, by whoever sends
        finally:
            async with self._news:
                self._lost = self._number
                self._news.notify_all()


def _id(plan: Plan | str) -> str:
    return plan if isinstance(plan, str) else plan.plan_id
