"""REST, version 1: a thin face over the engine; every error is a problem document with a stable code."""

import asyncio
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from math import inf
from typing import Annotated, Any

from fastapi import FastAPI, Path, Query, Request, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, PlainTextResponse, Response
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware

from optodrive import __version__
from optodrive.core.errors import (
    BoardFaultError,
    InputError,
    LinkError,
    NotReadyError,
    OptodriveError,
    OverBudgetError,
    RefusedError,
    abbreviate,
)
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.engine.live_stream import LiveStream
from optodrive.daemon.engine.metrics import CONTENT_TYPE
from optodrive.daemon.web.access_policy import AUDIT_FIELDS, AccessMiddleware, AccessPolicy, build_problem
from optodrive.daemon.web.openapi import ERROR_RESPONSES, EVENT_RESPONSES, extend_openapi
from optodrive.daemon.web.openapi_bodies import (
    PARAMETERS_SCHEMA,
    PATTERN_NAME_EXAMPLES,
    SEQUENCE_EXAMPLE,
    SEQUENCE_SCHEMA,
    build_request_body,
)
from optodrive.daemon.web.request_limits import BodyTooLargeError
from optodrive.daemon.web.static_files import add_page_routes
from optodrive.daemon.web.stop_priority import StopPriorityMiddleware, build_json_response
from optodrive.daemon.web.telemetry import DEFAULT_RATE_HZ, EventStream, Telemetry
from optodrive.planning.effective_config import build_effective_config
from optodrive.planning.feasibility import FitMode
from optodrive.planning.limiter.limiter import Policy
from optodrive.planning.pipeline import resolve_policy
from optodrive.planning.stimuli.pattern_registry import build_pattern, describe_patterns
from optodrive.planning.stimuli.sequence_file import parse_json, parse_sequence

JsonObject = dict[str, Any]
STATUS_BY_ERROR: tuple[tuple[type[OptodriveError], int], ...] = (
    (InputError, 422),
    (RefusedError, 409),
    (NotReadyError, 409),
    (BoardFaultError, 409),
    (LinkError, 503),
)
PlanId = Annotated[str, Path(max_length=40)]
DryRunQuery = Annotated[bool, Query(description="plan and limit only; nothing moves")]
NewestQuery = Annotated[bool, Query(description="take the place of everything that has not left for the board yet")]
StrictQuery = Annotated[bool, Query(description="the same as policy=refuse")]
PolicyQuery = Annotated[Policy, Query(description="what becomes of a frame that a cap does not allow as it is")]

RateQuery = Annotated[float, Query(ge=1, le=60, description="looks at the display a second, while it is warm")]
FitQuery = Annotated[FitMode, Query(description="what becomes of a sequence that does not fit on the beam as it is")]


def build_app(engine: Engine, policy: AccessPolicy) -> FastAPI:
    """The daemon's web application over a running engine."""
    display = engine.display
    access_middleware = Middleware(AccessMiddleware, policy=policy)
    telemetry = Telemetry(engine)
    app = FastAPI(
        generate_unique_id_function=lambda route: route.name,
        title="optodrive",
        version=__version__,
        middleware=[Middleware(StopPriorityMiddleware), access_middleware],
        responses=ERROR_RESPONSES,
        docs_url=None,
        redoc_url=None,
        lifespan=telemetry.lifespan,
    )
    app.state.telemetry = telemetry
    _add_error_handlers(app)
    add_page_routes(app)

    @app.get("/v1/health")
    async def get_health() -> JsonObject:
        """Whether the daemon runs; needs no token."""
        return {"status": "ok", "version": __version__}

    @app.get("/v1/state")
    async def get_state() -> JsonObject:
        """The board, the link, the queue, the display's heat."""
        return engine.snapshot()

    @app.get("/metrics", response_class=PlainTextResponse)
    async def get_metrics() -> PlainTextResponse:
        """Figures for Prometheus."""
        return PlainTextResponse(engine.render_metrics(), media_type=CONTENT_TYPE)

    @app.get("/v1/config")
    async def get_config() -> JsonObject:
        """The resolved configuration, as `optodrive config show --json`."""
        return build_effective_config(display)

    @app.post("/v1/arm")
    async def arm() -> JsonObject:
        """Arm the board: its indicator is lit for at least two seconds before it emits."""
        return await _await_result(engine.arm())

    @app.post("/v1/disarm")
    async def disarm() -> JsonObject:
        """Disarm; also acknowledges a fault whose cause is gone."""
        return await _await_result(engine.disarm())

    @app.post("/v1/stop")
    async def stop() -> JsonObject:
        """Gate off now, everything queued dropped, board disarmed."""
        return await _await_result(engine.stop())

    @app.post(
        "/v1/plans",
        status_code=201,
        response_model=JsonObject,
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
            lambda: parse_sequence(body, display.config, "body"), "push", dry_run, policy, fit, streamed=newest
        )
        return await build_json_response(await _await_plan(request, future), 201)

    @app.websocket("/v1/stream")
    async def stream_frames(socket: WebSocket, policy: PolicyQuery = "trim") -> None:
        """Frames in, the newest wins; what became of each out."""
        await LiveStream(engine, socket, policy, build_error_problem).run()

    @app.get("/v1/telemetry", status_code=200, response_class=EventStream, responses=EVENT_RESPONSES)
    async def stream_telemetry(rate_hz: RateQuery = DEFAULT_RATE_HZ) -> EventStream:
        """What happens now, as server-sent events until the caller leaves: state, display, pulses, budget, fault."""
        telemetry.require_capacity()
        return EventStream(telemetry.stream_events(rate_hz))

    @app.get("/v1/plans/{plan_id}", response_model=JsonObject)
    async def get_plan(
        plan_id: PlanId, pulses: Annotated[bool, Query(description="list every pulse")] = True
    ) -> Response:
        """One plan: what was planned, sent, executed."""
        return await build_json_response(engine.get_plan(plan_id, pulses))

    @app.delete("/v1/plans/{plan_id}")
    async def cancel_plan(plan_id: PlanId) -> JsonObject:
        """Take a plan out of the queue, or end it dark when it runs; the board stays armed."""
        return await _await_result(engine.cancel(plan_id))

    @app.get("/v1/patterns")
    async def list_patterns() -> JsonObject:
        """The named patterns and their parameters."""
        return {"patterns": describe_patterns()}

    @app.post(
        "/v1/patterns/{name}",
        status_code=201,
        response_model=JsonObject,
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
        """Build a named pattern, plan it, show it."""
        body = await request.body()
        parameters = parse_json(body, "body") if body.strip() else {}
        if not isinstance(parameters, dict):
            raise InputError("body", parameters, "an object of the pattern's parameters")
        policy = resolve_policy(policy, strict)
        future = engine.submit(lambda: build_pattern(name, parameters, display.config), name, dry_run, policy, fit)
        return await build_json_response(await _await_plan(request, future), 201)

    extend_openapi(app)
    return app


async def _await_plan(request: Request, future: "Future[JsonObject]") -> JsonObject:
    """What was planned, told to the audit file too."""
    answer = await _await_result(future)
    keys = {"plan": "plan", "name": "pattern", "planned": "pulses", "status": "plan_status"}
    request.scope[AUDIT_FIELDS].update({audit_name: answer[key] for key, audit_name in keys.items() if key in answer})
    return answer


async def _await_result(future: "Future[JsonObject]") -> JsonObject:
    return await asyncio.wrap_future(future)


def build_error_problem(error: OptodriveError) -> JsonObject:
    """An error as a problem document."""
    status = next((status for kind, status in STATUS_BY_ERROR if isinstance(error, kind)), 500)
    if error.code in ("no_plan", "unknown_pattern"):
        status = 404
    extensions: JsonObject = {}
    if isinstance(error, InputError):
        extensions = {"where": error.where, "value": abbreviate(error.value), "expected": error.expected}
    if isinstance(error, OverBudgetError):
        fits_after_s = error.earliest_s if error.earliest_s < inf else None
        extensions = {"pixel": error.pixel, "cap": error.cap, "margin_j": error.margin_j, "fits_later_s": fits_after_s}
    if isinstance(error, RefusedError) and error.feasibility is not None:
        extensions["feasibility"] = error.feasibility
    return build_problem(status, error.code, type(error).__name__.removesuffix("Error"), str(error), **extensions)


def _add_error_handlers(app: FastAPI) -> None:
    def build_response(document: dict[str, object]) -> JSONResponse:
        status = document["status"]
        return JSONResponse(document, status_code=int(str(status)), media_type="application/problem+json")

    def handles(kind: type[Exception]) -> Callable[[Callable[[Request, Any], Awaitable[JSONResponse]]], None]:
        return lambda handler: app.add_exception_handler(kind, handler)

    @handles(OptodriveError)
    async def handle_optodrive_error(request: Request, error: OptodriveError) -> JSONResponse:
        return build_response(build_error_problem(error))

    @handles(RequestValidationError)
    async def handle_validation_error(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return build_response(build_problem(422, "bad_input", "Bad input", f"{where}: {first['msg']}", where=where))

    @handles(HTTPException)
    async def handle_http_error(request: Request, error: HTTPException) -> JSONResponse:
        code = {404: "no_such_route", 405: "method_not_allowed"}.get(error.status_code, "http")
        return build_response(
            build_problem(error.status_code, code, str(error.detail), f"{request.method} {request.url.path}")
        )

    @handles(BodyTooLargeError)
    async def handle_body_too_large(request: Request, error: BodyTooLargeError) -> JSONResponse:
        return build_response(build_problem(413, "body_too_large", "Body too large", "the body grew past its bound"))
