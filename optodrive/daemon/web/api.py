"""The REST API, version 1, over a running engine."""

import asyncio
from concurrent.futures import Future
from typing import Annotated, Any

from fastapi import FastAPI, Path, Query, Request, WebSocket
from fastapi.responses import JSONResponse, PlainTextResponse, Response

from optodrive import __version__
from optodrive.core.errors import InputError
from optodrive.core.types.policy import Policy
from optodrive.daemon.engine.metrics import CONTENT_TYPE
from optodrive.daemon.one_process.engine import Engine
from optodrive.daemon.one_process.live_stream import LiveStream
from optodrive.daemon.responses.caller import CallerReport
from optodrive.daemon.responses.error_problem import build_error_problem
from optodrive.daemon.responses.health import HealthReport
from optodrive.daemon.responses.patterns import PatternList
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.state import StateReport
from optodrive.daemon.web.access_middleware import AUDIT_FIELDS, CALLER, AccessMiddleware
from optodrive.daemon.web.access_policy import AccessPolicy
from optodrive.daemon.web.error_handlers import add_error_handlers
from optodrive.daemon.web.openapi import ERROR_RESPONSES, EVENT_RESPONSES, extend_openapi
from optodrive.daemon.web.openapi_bodies import (
    PARAMETERS_SCHEMA,
    PATTERN_NAME_EXAMPLES,
    SEQUENCE_EXAMPLE,
    SEQUENCE_SCHEMA,
    build_request_body,
)
from optodrive.daemon.web.route_table import RoleRoutes, RouteTable
from optodrive.daemon.web.static_files import add_page_routes
from optodrive.daemon.web.stop_priority import StopPriorityMiddleware, build_json_response
from optodrive.daemon.web.telemetry import DEFAULT_RATE_HZ, EventStream, Telemetry
from optodrive.daemon.web.tokens import Token
from optodrive.planning.effective_config import EffectiveConfig, build_effective_config
from optodrive.planning.feasibility.report import FitMode
from optodrive.planning.pipeline import resolve_policy
from optodrive.planning.stimuli.pattern_registry import build_pattern, describe_patterns
from optodrive.planning.stimuli.sequence_file import parse_json, parse_sequence

PlanId = Annotated[str, Path(max_length=40)]
DryRunQuery = Annotated[bool, Query(description="plan and limit only; nothing moves")]
NewestQuery = Annotated[bool, Query(description="replace everything that is not yet committed to the board")]
StrictQuery = Annotated[bool, Query(description="the same as policy=refuse")]
PolicyQuery = Annotated[Policy, Query(description="treatment of a frame that exceeds a cap")]
FitQuery = Annotated[FitMode, Query(description="treatment of a sequence that does not fit on the beam")]
PulsesQuery = Annotated[bool, Query(description="list every pulse")]
DRY_RUN_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"model": PlanReport, "description": "A dry run: the plan is not stored"}
}
RateQuery = Annotated[float, Query(ge=1, le=60, description="display events per second while a pixel is warm")]


def build_app(engine: Engine, policy: AccessPolicy) -> FastAPI:
    """Build the daemon's web application over a running engine."""
    display = engine.display
    telemetry = Telemetry(engine)
    app = FastAPI(
        generate_unique_id_function=lambda route: route.name,
        title="optodrive",
        version=__version__,
        responses=ERROR_RESPONSES,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        lifespan=telemetry.lifespan,
    )
    app.state.telemetry = telemetry
    add_error_handlers(app)
    routes = RoleRoutes(app)
    add_page_routes(routes)

    @routes.get("/v1/health", None)
    async def get_health() -> HealthReport:
        """Return whether the daemon runs; needs no token."""
        return HealthReport(version=__version__)

    @routes.get("/v1/state", "viewer")
    async def get_state() -> StateReport:
        """Return the state of board, link, queue and planner."""
        return engine.snapshot()

    @routes.get("/v1/me", "viewer")
    async def get_me(request: Request) -> CallerReport:
        """Return name and role of the token that the request presented, and the routes that the role may not call."""
        token: Token = request.scope[CALLER]
        return CallerReport(name=token.name, role=token.role, refused=table.list_refused(token.role))

    @routes.get("/metrics", "viewer", response_class=PlainTextResponse)
    async def get_metrics() -> PlainTextResponse:
        """Return metrics for Prometheus."""
        return PlainTextResponse(engine.render_metrics(), media_type=CONTENT_TYPE)

    @routes.get("/v1/config", "viewer")
    async def get_config() -> EffectiveConfig:
        """Return the effective configuration, as `optodrive config show --json`."""
        return build_effective_config(display)

    @routes.post("/v1/arm", "armer")
    async def arm() -> StateReport:
        """Arm the board; its indicator is on for at least two seconds before it emits."""
        return await asyncio.wrap_future(engine.arm())

    @routes.post("/v1/disarm", "operator")
    async def disarm() -> StateReport:
        """Disarm the board; this also acknowledges a fault whose cause is gone."""
        return await asyncio.wrap_future(engine.disarm())

    @routes.post("/v1/stop", "viewer")
    async def stop() -> StateReport:
        """Switch the gate off, drop everything queued, disarm the board."""
        return await asyncio.wrap_future(engine.stop())

    @routes.post(
        "/v1/plans",
        "operator",
        status_code=201,
        response_model=PlanReport,
        responses=DRY_RUN_RESPONSES,
        openapi_extra=build_request_body("FRAMES.json: frames and trains", SEQUENCE_SCHEMA, SEQUENCE_EXAMPLE, True),
    )
    async def submit_plan(
        request: Request,
        dry_run: DryRunQuery = False,
        strict: StrictQuery = False,
        policy: PolicyQuery = "trim",
        newest: NewestQuery = False,
        fit: FitQuery = "as_is",
    ) -> Response:
        """Plan frames and trains, and show them."""
        body = await request.body()
        policy = resolve_policy(policy, strict)
        future = engine.submit(
            lambda: parse_sequence(body, display.config, "body"),
            "push",
            dry_run,
            policy,
            fit,
            streamed=newest,
            caller=request.scope[CALLER].name,
        )
        return await build_json_response(await _await_plan(request, future), 200 if dry_run else 201)

    @routes.websocket("/v1/stream", "operator")
    async def stream_frames(socket: WebSocket, policy: PolicyQuery = "trim") -> None:
        """Show streamed frames, of which the newest wins, and send the result of each."""
        await LiveStream(engine, socket, policy, socket.scope[CALLER].name, build_error_problem).run()

    @routes.get("/v1/telemetry", "viewer", status_code=200, response_class=EventStream, responses=EVENT_RESPONSES)
    async def stream_telemetry(rate_hz: RateQuery = DEFAULT_RATE_HZ) -> EventStream:
        """Send server-sent events until the client disconnects: state, display, pulses, budget, fault."""
        telemetry.require_capacity()
        return EventStream(telemetry.stream_events(rate_hz))

    @routes.get("/v1/plans/{plan_id}", "viewer", response_model=PlanReport)
    async def get_plan(plan_id: PlanId, pulses: PulsesQuery = True) -> Response:
        """Return one plan: what was planned, sent and executed."""
        return await build_json_response(engine.get_plan(plan_id, pulses))

    @routes.delete("/v1/plans/{plan_id}", "operator", response_model=PlanReport)
    async def cancel_plan(plan_id: PlanId) -> Response:
        """Remove a plan from the queue, or end it if it runs; the board stays armed."""
        report: PlanReport = await asyncio.wrap_future(engine.cancel(plan_id))
        return await build_json_response(report)

    @routes.get("/v1/patterns", "viewer")
    async def list_patterns() -> PatternList:
        """Return the named patterns and their parameters."""
        return PatternList(patterns=describe_patterns())

    @routes.post(
        "/v1/patterns/{name}",
        "operator",
        status_code=201,
        response_model=PlanReport,
        responses=DRY_RUN_RESPONSES,
        openapi_extra=build_request_body("the pattern's parameters", PARAMETERS_SCHEMA, {}, False),
    )
    async def play_pattern(
        name: Annotated[str, Path(max_length=80, json_schema_extra=PATTERN_NAME_EXAMPLES)],
        request: Request,
        dry_run: DryRunQuery = False,
        strict: StrictQuery = False,
        policy: PolicyQuery = "trim",
        fit: FitQuery = "as_is",
    ) -> Response:
        """Build a named pattern, plan it, and show it."""
        body = await request.body()
        parameters = parse_json(body, "body") if body.strip() else {}
        if not isinstance(parameters, dict):
            raise InputError("body", parameters, "an object of the pattern's parameters")
        policy = resolve_policy(policy, strict)
        future = engine.submit(
            lambda: build_pattern(name, parameters, display.config),
            name,
            dry_run,
            policy,
            fit,
            caller=request.scope[CALLER].name,
        )
        return await build_json_response(await _await_plan(request, future), 200 if dry_run else 201)

    @routes.get("/openapi.json", "viewer", include_in_schema=False)
    async def get_openapi() -> JSONResponse:
        """Return the OpenAPI document."""
        return JSONResponse(app.openapi())

    table = RouteTable(app.routes)
    extend_openapi(app, table)
    # The one that is added last is the outermost; both run in front of every route.
    app.add_middleware(AccessMiddleware, policy=policy, table=table)
    app.add_middleware(StopPriorityMiddleware)
    return app


async def _await_plan(request: Request, future: "Future[PlanReport]") -> PlanReport:
    """Wait for a plan and add its fields to the audit log."""
    report: PlanReport = await asyncio.wrap_future(future)
    request.scope[AUDIT_FIELDS] |= {
        "plan": report.plan,
        "pattern": report.name,
        "pulses": report.planned,
        "plan_status": report.status,
    }
    return report
