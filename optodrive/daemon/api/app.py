"""The REST API, version 1, over the daemon's other processes."""

import asyncio
import json
import time
from collections.abc import Coroutine
from functools import cache
from typing import Annotated, Any

from fastapi import FastAPI, Path, Query, Request, WebSocket
from fastapi.responses import PlainTextResponse, Response
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from optodrive import __version__
from optodrive.core.ipc import Message
from optodrive.core.types.push_options import Policy, PushOptions
from optodrive.daemon.api.access_middleware import AUDIT_FIELDS, AccessMiddleware, read_request
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.client_sockets import FingersSocket, HoldSocket
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.error_handlers import add_error_handlers
from optodrive.daemon.api.live_stream import LiveStream, StandingStream
from optodrive.daemon.api.openapi import (
    ERROR_RESPONSES,
    EVENT_RESPONSES,
    PATTERN_NAME_EXAMPLES,
    SEQUENCE_EXAMPLE,
    TAGS,
    build_request_body,
    extend_openapi,
)
from optodrive.daemon.api.request_limits import ARRIVED_S, CALLER, StopPriorityMiddleware
from optodrive.daemon.api.request_models import DIM_EXAMPLE, PushOptionsQuery, parse_dim_request
from optodrive.daemon.api.route_table import RoleRoutes, RouteTable
from optodrive.daemon.api.static_files import add_page_routes
from optodrive.daemon.api.telemetry_hub import DEFAULT_RATE_HZ, EventStream
from optodrive.daemon.api.tokens import Token, is_role_sufficient
from optodrive.daemon.engine.metrics import CONTENT_TYPE
from optodrive.daemon.push import Push
from optodrive.daemon.responses.plan import PatternList, PlanReport
from optodrive.daemon.responses.problem import MEDIA_TYPE, Problem
from optodrive.daemon.responses.state import CallerReport, HealthReport, ReloadReport, StateReport
from optodrive.link.service.status import NO_EPOCH
from optodrive.planning.effective_config import EffectiveConfig, build_effective_config
from optodrive.planning.stimuli.pattern_registry import describe_patterns, find_pattern

PlanId = Annotated[str, Path(max_length=40, description="id of the plan, as the answer to its push states it")]
PatternName = Annotated[
    str, Path(max_length=80, description="name of the pattern", json_schema_extra=PATTERN_NAME_EXAMPLES)
]
DryRunQuery = Annotated[bool, Query(description="plan and limit only; nothing moves")]
NewestQuery = Annotated[bool, Query(description="replace everything that is not yet committed to the board")]
NameQuery = Annotated[
    str,
    Query(min_length=1, max_length=40, pattern=r"^[\w.-]+( [\w.-]+)*$", description="what the plan is called in lists"),
]
PolicyQuery = Annotated[Policy, Query(description="treatment of a frame that exceeds a cap")]
StandingQuery = Annotated[bool, Query(description="keep the newest frame up until the next one")]
TouchedOnlyQuery = Annotated[bool, Query(description="with standing: leave dots dark that no finger touches")]
PulsesQuery = Annotated[bool, Query(description="list every pulse")]
DRY_RUN_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"model": PlanReport, "description": "A dry run: the plan is not stored"}
}
RateQuery = Annotated[float, Query(ge=1, le=60, description="display events per second while a pixel is warm")]


def build_app(daemon: DaemonClient, policy: AccessPolicy) -> FastAPI:
    """Build the daemon's web application."""
    config_json = build_effective_config(daemon.display).model_dump_json().encode()
    patterns_json = PatternList(patterns=describe_patterns()).model_dump_json().encode()
    app = FastAPI(
        generate_unique_id_function=lambda route: route.name,
        title="optodrive",
        summary="REST API of a tactile display driven by projected light",
        openapi_tags=TAGS,
        version=__version__,
        responses=ERROR_RESPONSES,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
    )
    add_error_handlers(app)
    routes = RoleRoutes(app)
    add_page_routes(routes)

    @routes("GET /v1/health", None, tags=["state"])
    async def get_health() -> HealthReport:
        """Return whether the daemon runs. This needs no token."""
        return HealthReport(version=__version__)

    @routes("GET /v1/state", "viewer", tags=["state"], response_model=StateReport)
    async def get_state() -> Response:
        """Return the state of board, link, queue and planner."""
        return _send_state(daemon)

    @routes("GET /v1/me", "viewer", tags=["state"])
    async def get_me(request: Request) -> CallerReport:
        """Return name and role of the token that the request presented, and the routes that the role may not call."""
        token: Token = request.scope[CALLER]
        return CallerReport(name=token.name, role=token.role, refused=table.list_refused(token.role))

    @routes("GET /metrics", "viewer", tags=["state"], response_class=PlainTextResponse)
    async def get_metrics() -> Response:
        """Return metrics for Prometheus."""
        return _relay(await daemon.planner.call("metrics"), CONTENT_TYPE)

    @routes("GET /v1/config", "viewer", tags=["state"], response_model=EffectiveConfig)
    async def get_config() -> Response:
        """Return the effective configuration, as `optodrive config show --json`."""
        return Response(config_json, media_type="application/json")

    @routes("POST /v1/arm", "armer", tags=["board"], response_model=StateReport)
    async def arm(request: Request) -> Response:
        """Arm the board. Its indicator is on for at least two seconds before it emits."""
        await daemon.link.arm(request.scope[CALLER].name)
        return _send_state(daemon)

    @routes.websocket("/v1/hold", "armer")
    async def hold(socket: WebSocket) -> None:
        """Arm the board for as long as the connection lasts and its client sends a message every second."""
        await HoldSocket(daemon.link, socket, socket.scope[CALLER].name).run()

    @routes(
        "PUT /v1/dim",
        "operator",
        tags=["board"],
        response_model=StateReport,
        openapi_extra=build_request_body("DimRequest", "the share of full power, 0 to 1", DIM_EXAMPLE, True),
    )
    async def dim(request: Request) -> Response:
        """Cap the power of every pulse of the plans from now on. Only an armer may raise it again."""
        share = parse_dim_request(await request.body()).share
        request.scope[AUDIT_FIELDS]["share"] = share
        may_raise = is_role_sufficient(request.scope[CALLER].role, "armer")
        result = await daemon.planner.call("dim", share=share, may_raise=may_raise)
        return _send_state(daemon) if result.fields["status"] == 200 else _relay(result)

    @routes("POST /v1/disarm", "operator", tags=["board"], response_model=StateReport)
    async def disarm() -> Response:
        """Disarm the board. This also acknowledges a fault whose cause is gone."""
        await daemon.link.command("disarm")
        return _send_state(daemon)

    @routes("POST /v1/pause", "operator", tags=["board"], response_model=StateReport)
    async def pause() -> Response:
        """Switch the gate off. The board stays armed and plans wait, for five minutes at most."""
        await daemon.link.command("pause")
        return _send_state(daemon)

    @routes("POST /v1/resume", "operator", tags=["board"], response_model=StateReport)
    async def resume() -> Response:
        """Play the pulses left at the pause, planned anew for the heat that is left, and the plans that wait."""
        await daemon.link.command("resume")
        return _send_state(daemon)

    @routes("POST /v1/reload", "armer", tags=["service"], response_model=ReloadReport)
    async def reload() -> Response:
        """Read configuration and tokens again, and apply changes that need no restart, as SIGHUP does for a service."""
        result = await daemon.reloads.request()
        if isinstance(result, Problem):
            return Response(result.to_json(), result.status, media_type=MEDIA_TYPE)
        return Response(result.model_dump_json(), media_type="application/json")

    @routes("POST /v1/stop", "viewer", tags=["board"], response_model=StateReport)
    async def stop() -> Response:
        """Switch the gate off, drop everything queued, disarm the board."""
        await daemon.link.command("stop")
        return _send_state(daemon)

    @routes(
        "POST /v1/plans",
        "operator",
        tags=["plans"],
        status_code=201,
        response_model=PlanReport,
        responses=DRY_RUN_RESPONSES,
        openapi_extra=build_request_body("FrameSequence", "FRAMES.json: frames and trains", SEQUENCE_EXAMPLE, True),
    )
    async def submit_plan(
        request: Request,
        options: PushOptionsQuery,
        dry_run: DryRunQuery = False,
        newest: NewestQuery = False,
        name: NameQuery = "push",
    ) -> Response:
        """Plan frames and trains, and show them."""
        return await _plan_body(daemon, request, "sequence", name, options, newest, dry_run)

    @routes.websocket("/v1/stream", "operator")
    async def stream_frames(
        socket: WebSocket,
        policy: PolicyQuery = "trim",
        standing: StandingQuery = False,
        touched_only: TouchedOnlyQuery = False,
    ) -> None:
        """Show streamed frames, of which the newest wins, and send the result of each."""
        stream = (daemon, socket, policy, socket.scope[CALLER].name)
        await (StandingStream(*stream, touched_only) if standing else LiveStream(*stream)).run()

    @routes.websocket("/v1/fingers", "operator")
    async def track_fingers(socket: WebSocket) -> None:
        """Take the places of fingertips, for which standing frames are refreshed first."""
        await FingersSocket(daemon, socket).run()

    @routes(
        "GET /v1/telemetry",
        "viewer",
        tags=["state"],
        status_code=200,
        response_class=EventStream,
        responses=EVENT_RESPONSES,
    )
    async def stream_telemetry(rate_hz: RateQuery = DEFAULT_RATE_HZ) -> EventStream:
        """Send server-sent events until the client disconnects: state, display, pulses, budget, fault."""
        daemon.hub.require_capacity()
        return EventStream(daemon.hub.stream_events(rate_hz))

    @routes("GET /v1/plans/{plan_id}", "viewer", tags=["plans"], response_model=PlanReport)
    async def get_plan(plan_id: PlanId, pulses: PulsesQuery = True) -> Response:
        """Return one plan with its planned, sent and executed pulses."""
        return _relay(await daemon.planner.call("get_plan", plan=plan_id, pulses=pulses))

    @routes("DELETE /v1/plans/{plan_id}", "operator", tags=["plans"], response_model=PlanReport)
    async def cancel_plan(plan_id: PlanId) -> Response:
        """Remove a plan from the queue, or end it if it runs. The board stays armed."""
        return _relay(await daemon.planner.call("cancel", plan=plan_id))

    @routes("GET /v1/patterns", "viewer", tags=["patterns"], response_model=PatternList)
    async def list_patterns() -> Response:
        """Return the named patterns and their parameters."""
        return Response(patterns_json, media_type="application/json")

    @routes(
        "POST /v1/patterns/{name}",
        "operator",
        tags=["patterns"],
        status_code=201,
        response_model=PlanReport,
        responses=DRY_RUN_RESPONSES,
        openapi_extra=build_request_body("PatternParameters", "the pattern's parameters", {}, False),
    )
    async def play_pattern(
        name: PatternName,
        request: Request,
        options: PushOptionsQuery,
        dry_run: DryRunQuery = False,
    ) -> Response:
        """Build a named pattern, plan it, and show it."""
        with_default: PushOptions = {"policy": find_pattern(name).policy, **options}
        return await _plan_body(daemon, request, "pattern", name, with_default, False, dry_run)

    @cache
    def encode_openapi() -> bytes:
        return json.dumps(app.openapi(), ensure_ascii=False).encode()

    @routes("GET /openapi.json", "viewer", include_in_schema=False)
    async def get_openapi() -> Response:
        """Return the OpenAPI document."""
        # Its first encoding takes a tenth of a second, for which STOP must not wait.
        return Response(await run_in_threadpool(encode_openapi), media_type="application/json")

    table = RouteTable(app.routes)
    extend_openapi(app, table)
    # The one that is added last is the outermost; both run in front of every route.
    app.add_middleware(AccessMiddleware, policy=policy, table=table)
    app.add_middleware(StopPriorityMiddleware, permits_stop=lambda scope: policy.permits_stop(read_request(scope)))
    return app


async def _plan_body(
    daemon: DaemonClient,
    request: Request,
    source: str,
    name: str,
    options: PushOptions,
    streamed: bool,
    is_dry_run: bool,
) -> Response:
    """Plan a body. The push's epoch is that of its arrival: a STOP since then ends it.

    Raise LinkError without a link process, which a dry run does not need.
    """
    arrived_s = request.scope.get("state", {}).get(ARRIVED_S) or time.monotonic()
    epoch = NO_EPOCH if is_dry_run else daemon.link.require_epoch_at(arrived_s)
    push = Push(name, options, arrived_s, epoch, request.scope[CALLER].name, streamed)
    body = await request.body()
    work = daemon.plan_dry_run(source, body, push) if is_dry_run else daemon.push(source, body, push)
    result = await _finish_unless_left(request, work)
    request.scope[AUDIT_FIELDS] |= result.fields.get("audit") or {}
    return _relay(result)


async def _finish_unless_left(request: Request, work: Coroutine[Any, Any, Message]) -> Message:
    """Return the result of some work, which is dropped when the caller leaves: nobody waits for it."""
    task, leaving = asyncio.ensure_future(work), asyncio.ensure_future(_wait_until_left(request))
    try:
        await asyncio.wait((task, leaving), return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            return task.result()
        raise ClientDisconnect
    finally:
        for each in (task, leaving):
            each.cancel()
        await asyncio.gather(task, leaving, return_exceptions=True)


async def _wait_until_left(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _send_state(daemon: DaemonClient) -> Response:
    return Response(daemon.encode_state(), media_type="application/json")


def _relay(result: Message, media_type: str = "application/json") -> Response:
    """Answer with the body of another process's result."""
    status: int = result.fields["status"]
    return Response(result.payload, status, media_type=media_type if status < 400 else MEDIA_TYPE)
