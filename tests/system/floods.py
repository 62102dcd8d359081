"""Floods of a daemon's web interface, each in a process of its own: python floods.py NAME [WORKERS].

The process reads one line of JSON from stdin: address, port, tokens by role and number of pixels. It prints `ready`
once every worker has counted an outcome or broken off, repeats its flood until stdin ends, and prints the outcomes
that it counted. A flood that waits runs once per further line on stdin, and `over` is printed after it. No flood but
`callers` presents the token of an armer, and none pushes a valid plan: such a caller must not darken a show, nor delay
STOP.
"""

import asyncio
import json
import os
import re
import socket
import struct
import sys
import zlib
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from typing import Any

PAUSE_S = 0.02
"""Pause after an exchange that the daemon refused to begin or broke off."""
BODY_MAX_BYTES = 8_000_000
"""The default of [daemon] body_max_bytes; the large bodies are slightly smaller."""
BROKEN = (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError, ValueError)
BEGUN: ContextVar[asyncio.Event] = ContextVar("BEGUN", default=asyncio.Event())  # noqa: B039 - nobody waits for this one
"""Set when this worker's part of the flood has reached the daemon."""
TEXT, BINARY, CONTINUED, CLOSE, PING = 0x1, 0x2, 0x0, 0x8, 0x9


class Target:
    """The daemon: builds requests, exchanges them, counts the outcomes."""

    def __init__(self, host: str, port: int, tokens: dict[str, str], pixels: int, interval_s: float = 0.0) -> None:
        self.host, self.port, self.tokens, self.pixels, self.interval_s = host, port, tokens, pixels, interval_s
        self.counts: Counter[str] = Counter()

    def count(self, outcome: str, number: int = 1) -> None:
        """Count an outcome."""
        self.counts[outcome] += number
        BEGUN.get().set()

    def build_head(
        self, method: str, path: str, role: str | None = "operator", length: int = 0, **headers: str
    ) -> bytes:
        """Build the head of a request. Underscores in the names of headers become hyphens.

        role: None for no token
        """
        fields = {"Host": f"{self.host}:{self.port}", "Content_Length": str(length)} | headers
        if role is not None:
            fields["Authorization"] = f"Bearer {self.tokens[role]}"
        lines = [f"{name.replace('_', '-')}: {value}" for name, value in fields.items()]
        return "\r\n".join([f"{method} {path} HTTP/1.1", *lines, "\r\n"]).encode()

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Open a connection."""
        return await asyncio.open_connection(self.host, self.port)

    async def read_answer(self, reader: asyncio.StreamReader) -> int:
        """Read a response with a length, discard its body, count and return its status."""
        head = await reader.readuntil(b"\r\n\r\n")
        status = int(head.split(None, 2)[1])
        length = re.search(rb"(?i)content-length: (\d+)", head)
        if length:
            await reader.readexactly(int(length[1]))
        self.count(str(status))
        return status

    async def exchange(self, head: bytes, body: bytes = b"") -> int:
        """Send a request on a connection of its own and return the status."""
        reader, writer = await self.connect()
        try:
            writer.write(head)
            with suppress(ConnectionError):  # refused by its length: the response is there all the same
                for begin in range(0, len(body), 1 << 16):
                    writer.write(body[begin : begin + (1 << 16)])
                    await writer.drain()
            return await self.read_answer(reader)
        finally:
            writer.close()

    async def open_stream(self, **headers: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Open the WebSocket of streamed frames."""
        reader, writer = await self.connect()
        upgrade = {
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec_WebSocket_Version": "13",
            "Sec_WebSocket_Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        }
        writer.write(self.build_head("GET", "/v1/stream", **upgrade, **headers))
        status = int((await reader.readuntil(b"\r\n\r\n")).split(None, 2)[1])
        self.count(str(status))
        if status != 101:
            writer.close()
            raise ConnectionError(f"answered {status}")
        return reader, writer


Work = Callable[[Target, int], Awaitable[object]]


@dataclass(frozen=True)
class Flood:
    """A flood: `work` is repeated by `workers` tasks at once. waits: all do it once per line on stdin."""

    work: Work
    workers: int
    waits: bool = False


FLOODS: dict[str, Flood] = {}


def flood(workers: int = 1, waits: bool = False) -> Callable[[Work], Work]:
    """Register a flood under its function's name with spaces."""

    def register(work: Work) -> Work:
        FLOODS[work.__name__.replace("_", " ")] = Flood(work, workers, waits)
        return work

    return register


# --- bodies ----------------------------------------------------------------------------------------------------------


@cache
def build_full_frames(count: int, pixels: int) -> bytes:
    """Build a valid sequence of frames that raise every pixel: about 1.4 kB per frame of 437 pixels."""
    heights = ",".join(["60"] * pixels)
    frames = [f'{{"show_at_s":{k},"duration_s":1,"target_um":[{heights}]}}' for k in range(count)]
    return f'{{"frames":[{",".join(frames)}]}}'.encode()


@cache
def build_duplicate_keys(size_bytes: int) -> bytes:
    """Build an object of many keys of which only the last is there twice, which costs a naive search the most."""
    keys = ",".join(f'"{k:05d}":1' for k in range(size_bytes // 10))
    return f'{{{keys},"{size_bytes // 10 - 1:05d}":1}}'.encode()


@cache
def build_refused_bodies(pixels: int) -> tuple[bytes, ...]:
    """Build eleven bodies of about 8 MB that are not a sequence."""
    size = BODY_MAX_BYTES - 100_000
    keys = build_duplicate_keys(size)[1:-1]
    frame = b'{"show_at_s":0,"duration_s":1,"target_um":'
    valid = build_full_frames(size // (3 * pixels + 60), pixels)
    return (
        b'{"frames":[' + frame + b"{" + keys[: keys.rindex(b",")] + b"}}]}",
        b'{"frames":[' + frame + b"[" + b"0," * (size // 2) + b"0]}]}",
        b'{"frames":[' + b"{}," * (size // 3) + b"{}]}",
        b'{"trains":[' + b'{"pixel":1},' * (size // 12) + b"{}]}",
        b'{"frames":[{"id":"' + b"x" * size + b'"}]}',
        b'{"frames":[' + frame + b"{" + keys + b"}}]}",
        b'{"frames":' + b"1" * size + b"}",
        valid[:-2] + b",{}]}",
        b"[" * size,
        b" " * size + b"{",
        b'{"frames":[' + b"1e-5," * (size // 5) + b"1]}",
    )


def list_routes() -> list[tuple[str, str]]:
    """List the methods and paths that take a request."""
    paths = ["/v1/plans", "/v1/plans?newest=true", "/v1/plans?dry_run=true", "/v1/arm", "/v1/disarm"]
    paths += ["/v1/patterns/pixel?dry_run=true", "/v1/patterns/x"]
    reads = ["/", "/v1/state", "/v1/config", "/v1/patterns", "/v1/plans/p1", "/v1/health", "/metrics", "/openapi.json"]
    return [*(("POST", path) for path in paths), *(("GET", path) for path in reads), ("DELETE", "/v1/plans/p1")]


@flood(workers=2)
async def bodies_of_every_kind(target: Target, number: int) -> None:
    """Send refused bodies of 8 and 9 MB for every route. No role may arm or disarm."""
    size = BODY_MAX_BYTES - 1000
    kinds = (b"\xff" * size, b'"' + b"x" * (size - 2) + b'"', b"{}" + b" " * (size - 2), b"0" * (size + 1_100_000))
    for method, path in list_routes()[number::2]:
        role = "viewer" if path in ("/v1/arm", "/v1/disarm") else "operator"
        for body in kinds:
            with suppress(*BROKEN):
                await target.exchange(target.build_head(method, path, role, len(body)), body)


@flood(workers=1)
async def duplicate_keys_to_patterns(target: Target, number: int) -> None:
    """389 kB and 589 kB of keys of which one is there twice."""
    for size in (389_000, 589_000):
        body = build_duplicate_keys(size)
        await target.exchange(target.build_head("POST", "/v1/patterns/pixel", length=len(body)), body)


@flood(workers=1)
async def duplicate_keys_to_the_stream(target: Target, number: int) -> None:
    """389 kB and 589 kB of keys of which one is there twice, as a frame."""
    reader, writer = await target.open_stream()
    try:
        while True:
            for size in (389_000, 589_000):
                write_frame(writer, TEXT, build_duplicate_keys(size))
                await writer.drain()
                await read_some(target, reader)
    finally:
        writer.close()


@flood(workers=2)
async def refused_bodies_of_8_MB(target: Target, number: int) -> None:
    """Eleven kinds of body for a plan, all answered 422 or 400."""
    for body in build_refused_bodies(target.pixels)[number::2]:
        with suppress(*BROKEN):
            await target.exchange(target.build_head("POST", "/v1/plans", length=len(body)), body)


@flood(workers=3)
async def nested_JSON(target: Target, number: int) -> None:
    """Lists and objects in each other, up to 1 MB deep."""
    for depth in (100, 900, 5_000, 1_000_000):
        for body in (b"[" * depth + b"]" * depth, b'{"a":' * depth + b"1" + b"}" * depth, b'{"frames":' + b"[" * depth):
            path = ("/v1/plans", "/v1/patterns/pixel", "/v1/plans?dry_run=true")[number]
            await target.exchange(target.build_head("POST", path, length=len(body)), body)


@flood(workers=300)
async def slow_bodies(target: Target, number: int) -> None:
    """One byte of the body per second."""
    reader, writer = await target.connect()
    try:
        writer.write(target.build_head("POST", "/v1/plans", length=100_000))
        await trickle(target, reader, writer, b"{" + b" " * 99_998 + b"}")
    finally:
        writer.close()


@flood(workers=300)
async def slow_headers(target: Target, number: int) -> None:
    """One byte of the head per second, without a token."""
    reader, writer = await target.connect()
    try:
        await trickle(target, reader, writer, b"GET /v1/health HTTP/1.1\r\nX-Slow: " + b"x" * 100_000)
    finally:
        writer.close()


async def trickle(target: Target, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, data: bytes) -> None:
    """Send a byte per second until the daemon closes or answers."""
    target.count("opened")
    for k in range(len(data)):
        writer.write(data[k : k + 1])
        with suppress(TimeoutError):
            answer = await asyncio.wait_for(reader.read(4096), 1.0)
            target.count(answer.split(None, 2)[1].decode() if answer else "closed")
            return


# --- connections -----------------------------------------------------------------------------------------------------


@flood(workers=2000)
async def idle_connections(target: Target, number: int) -> None:
    """2,000 connections without a request, opened again when the daemon closes them."""
    await asyncio.sleep(number * 0.5e-3)
    reader, writer = await target.connect()
    target.count("opened")
    try:
        await reader.read(1)
        target.count("closed")
    finally:
        writer.close()
    await asyncio.sleep(0.5)


@flood(workers=4)
async def connection_churn(target: Target, number: int) -> None:
    """Connections that are closed at once, half of them after a request without a token."""
    loop = asyncio.get_running_loop()
    for k in range(100):
        with socket.socket() as link:
            link.setblocking(False)
            await asyncio.wait_for(loop.sock_connect(link, (target.host, target.port)), 5.0)
            if k % 2:
                link.send(target.build_head("GET", "/v1/health", role=None))
            target.count("opened")


@flood(workers=4)
async def pipelined_requests(target: Target, number: int) -> None:
    """500 requests in one write, again and again, on one connection."""
    reader, writer = await target.connect()
    try:
        for _ in range(20):
            writer.write(target.build_head("GET", "/v1/state", "viewer") * 500)
            for _ in range(500):
                await asyncio.wait_for(target.read_answer(reader), 10.0)
    finally:
        writer.close()


@flood(workers=32)
async def kept_alive_GETs(target: Target, number: int) -> None:
    """The state, as fast as it is answered, or once per interval."""
    reader, writer = await target.connect()
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    try:
        for _ in range(500):
            writer.write(target.build_head("GET", "/v1/state", "viewer"))
            await asyncio.wait_for(target.read_answer(reader), 10.0)
            if target.interval_s:
                due_s = max(due_s + target.interval_s, loop.time())
                await asyncio.sleep(due_s - loop.time())
    finally:
        writer.close()


@flood(workers=8)
async def guesses(target: Target, number: int) -> None:
    """Wrong tokens, insufficient roles, foreign Hosts and Origins at the routes of arming."""
    for path in ("/v1/arm", "/v1/disarm", "/v1/plans"):
        wrong = {"Authorization": f"Bearer {os.urandom(12).hex()}"}
        await target.exchange(target.build_head("POST", path, None, **wrong))
        await target.exchange(target.build_head("POST", path, "viewer"))
        await target.exchange(target.build_head("POST", path, "operator", Host="evil.example"))
        await target.exchange(target.build_head("POST", path, "operator", Origin="https://evil.example"))


@flood(workers=40, waits=True)
async def callers(target: Target, number: int) -> None:
    """40 callers arm, disarm and stop at the moment of the measured STOP."""
    path = ("/v1/stop", "/v1/disarm", "/v1/stop", "/v1/arm")[number % 4]
    await target.exchange(target.build_head("POST", path, "armer"))


# --- WebSocket -------------------------------------------------------------------------------------------------------


def write_frame(writer: asyncio.StreamWriter, opcode: int, data: bytes, is_final: bool = True, bits: int = 0) -> None:
    """Write a frame with a mask of zeros."""
    writer.write(build_frame_head(opcode, len(data), is_final, bits) + data)


def build_frame_head(opcode: int, length: int, is_final: bool = True, bits: int = 0) -> bytes:
    """Build a frame's head.

    bits: reserved bits, 0x40 for a compressed message
    """
    first = (0x80 if is_final else 0) | bits | opcode
    if length < 126:
        return struct.pack(">BBI", first, 0x80 | length, 0)
    if length < 1 << 16:
        return struct.pack(">BBHI", first, 0x80 | 126, length, 0)
    return struct.pack(">BBQI", first, 0x80 | 127, length, 0)


async def read_some(target: Target, reader: asyncio.StreamReader, timeout_s: float = 60.0) -> None:
    """Read the bytes that the daemon sent. Raise ConnectionError at their end."""
    if not await asyncio.wait_for(reader.read(1 << 16), timeout_s):
        target.count("closed")
        raise ConnectionError("closed")
    target.count("read")


async def drain_answers(target: Target, reader: asyncio.StreamReader) -> None:
    """Read until the daemon closes."""
    with suppress(*BROKEN):
        while True:
            await read_some(target, reader)


@flood(workers=4)
async def pings(target: Target, number: int) -> None:
    """Pings of 125 bytes as fast as the socket takes them."""
    reader, writer = await target.open_stream()
    reading = asyncio.create_task(drain_answers(target, reader))
    ping = build_frame_head(PING, 125) + b"p" * 125
    try:
        while not reading.done():
            writer.write(ping * 500)
            target.count("pings", 500)
            await writer.drain()
            await asyncio.sleep(0)
    finally:
        reading.cancel()
        writer.close()


@cache
def build_compressed_zeros() -> bytes:
    """Compress a message of nearly 8 MB to about 8 kB."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    data = packer.compress(b" " * (BODY_MAX_BYTES - 1000)) + packer.flush(zlib.Z_SYNC_FLUSH)
    return data[:-4]


@flood(workers=2)
async def compressed_frames(target: Target, number: int) -> None:
    """150 frames of 8 kB that each expand to 8 MB: 1.2 MB on the wire."""
    data = build_compressed_zeros()
    offer = "permessage-deflate; client_no_context_takeover"
    reader, writer = await target.open_stream(Sec_WebSocket_Extensions=offer)
    reading = asyncio.create_task(drain_answers(target, reader))
    try:
        for _ in range(150):
            write_frame(writer, TEXT, data, bits=0x40)
            target.count("frames")
            await writer.drain()
        await asyncio.wait([reading], timeout=20.0)
    finally:
        reading.cancel()
        writer.close()


@flood(workers=3)
async def fragmented_frames(target: Target, number: int) -> None:
    """Messages in fragments of one byte."""
    reader, writer = await target.open_stream()
    reading = asyncio.create_task(drain_answers(target, reader))
    fragment = build_frame_head(CONTINUED, 1, is_final=False) + b" "
    try:
        write_frame(writer, TEXT, b"{", is_final=False)
        for _ in range(2_000):
            writer.write(fragment * 1000)
            target.count("fragments", 1000)
            await writer.drain()
            await asyncio.sleep(0)
    finally:
        reading.cancel()
        writer.close()


@flood(workers=2)
async def oversize_frames(target: Target, number: int) -> None:
    """Frames of 9 MB, and a head that announces 4 EB."""
    for length in (9_000_000, 1 << 62):
        reader, writer = await target.open_stream()
        try:
            writer.write(build_frame_head(BINARY, length))
            with suppress(*BROKEN):
                for _ in range(140):
                    writer.write(bytes(1 << 16))
                    await writer.drain()
            await drain_answers(target, reader)
        finally:
            writer.close()


# --- dry runs --------------------------------------------------------------------------------------------------------


async def abandon_dry_run(target: Target, frames: int) -> None:
    """Send a valid dry run and hang up 0.3 s after its last byte."""
    body = build_full_frames(frames, target.pixels)
    _, writer = await target.connect()
    try:
        writer.write(target.build_head("POST", "/v1/plans?dry_run=true", length=len(body)) + body)
        await writer.drain()
        target.count("sent")
        await asyncio.sleep(0.3)
    finally:
        writer.close()


@flood(workers=2)
async def abandoned_dry_runs_of_1_MB(target: Target, number: int) -> None:
    """730 full frames, and nobody waits for the answer."""
    await abandon_dry_run(target, 1_000_000 // (3 * target.pixels + 50))


@flood(workers=1)
async def abandoned_dry_runs_of_8_MB(target: Target, number: int) -> None:
    """5,700 full frames, and nobody waits for the answer."""
    await abandon_dry_run(target, 7_800_000 // (3 * target.pixels + 50))


@flood(workers=1)
async def valid_previews(target: Target, number: int) -> None:
    """A dry run of 750 full frames, and its answer is awaited."""
    body = build_full_frames(750, target.pixels)
    target.count("sent")
    await target.exchange(target.build_head("POST", "/v1/plans?dry_run=true", length=len(body)), body)


# --- watchers --------------------------------------------------------------------------------------------------------


@flood(workers=20)
async def telemetry_that_is_not_read(target: Target, number: int) -> None:
    """20 watchers at 60 events per second who do not read."""
    loop = asyncio.get_running_loop()
    with socket.socket() as link:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        link.setblocking(False)
        await asyncio.wait_for(loop.sock_connect(link, (target.host, target.port)), 5.0)
        await loop.sock_sendall(link, target.build_head("GET", "/v1/telemetry?rate_hz=60", "viewer"))
        target.count("opened")
        await asyncio.sleep(3600.0)


async def watch_telemetry(target: Target, rate_hz: int) -> None:
    """Read telemetry until it ends."""
    reader, writer = await target.connect()
    try:
        writer.write(target.build_head("GET", f"/v1/telemetry?rate_hz={rate_hz}", "viewer"))
        while data := await reader.read(1 << 16):
            target.count("bytes", len(data))
    finally:
        writer.close()


@flood(workers=20)
async def telemetry_that_is_read(target: Target, number: int) -> None:
    """20 watchers at 60 events per second."""
    await watch_telemetry(target, 60)


@flood(workers=6)
async def pages(target: Target, number: int) -> None:
    """Six pages: telemetry at 30 events per second, the state every 0.5 s, and all files every 2 s."""
    watching = asyncio.create_task(watch_telemetry(target, 30))
    reader, writer = await target.connect()
    try:
        files = ["/", *(f"/page/{name}" for name in PAGE_FILES)]
        for k in range(40):
            for path in [*(files if k % 4 == 0 else ()), "/v1/state"]:
                writer.write(target.build_head("GET", path, "viewer"))
                await target.read_answer(reader)
            await asyncio.sleep(0.5)
    finally:
        watching.cancel()
        writer.close()


PAGE_FILES = ("main.js", "api.js", "display.js", "draw.js", "gauges.js", "plans.js", "telemetry.js", "style.css")


# --- process ---------------------------------------------------------------------------------------------------------


async def attempt(target: Target, item: Flood, number: int) -> bool:
    """Do one worker's part once. Return whether it was not broken off."""
    try:
        await item.work(target, number)
    except BROKEN as error:
        target.count(type(error).__name__)
        return False
    return True


async def repeat_work(target: Target, item: Flood, number: int, begun: asyncio.Event) -> None:
    """Repeat one worker's part until it is cancelled."""
    BEGUN.set(begun)
    while True:
        if not await attempt(target, item, number):
            await asyncio.sleep(PAUSE_S if item.workers < 100 else 1.0)
        begun.set()


async def announce(begun: list[asyncio.Event]) -> None:
    """Print `ready` once every worker has begun."""
    for event in begun:
        await event.wait()
    print("ready", flush=True)


def report_unless_broken(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report an error that nobody awaited, unless a connection broke: the daemon may do that to a flood."""
    if not isinstance(context.get("exception"), BROKEN):
        loop.default_exception_handler(context)


async def run_flood(name: str, workers: int | None = None) -> None:
    """Run a flood until stdin ends."""
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(report_unless_broken)
    lines = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    target, item = Target(**json.loads(await lines.readline())), FLOODS[name]
    numbers = range(workers or item.workers)
    begun = [] if item.waits else [asyncio.Event() for _ in numbers]
    tasks = [asyncio.create_task(repeat_work(target, item, k, event)) for k, event in enumerate(begun)]
    tasks.append(asyncio.create_task(announce(begun)))
    while await lines.readline():
        if item.waits:
            await asyncio.gather(*(attempt(target, item, k) for k in numbers))
            print("over", flush=True)
    pending = {*tasks}
    while pending:  # a task may miss one cancellation, if what it waits for ends at that moment
        for task in pending:
            task.cancel()
        _, pending = await asyncio.wait(pending, timeout=0.2)
    results = await asyncio.gather(*tasks, return_exceptions=True)
    print(json.dumps(target.counts), flush=True)
    for error in results:
        if isinstance(error, Exception):
            raise error


if __name__ == "__main__":
    asyncio.run(run_flood(sys.argv[1], *map(int, sys.argv[2:])))
