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
from optodrive.daemon.web.access_policy import FACTS, Door, Guard, problem
from optodrive.daemon.web.openapi import ERRORS, EVENTS, describe
from optodrive.daemon.web.openapi_bodies import PARAMETERS, PATTERN_NAMES, SEQUENCE, SHOWN, json_body
from optodrive.daemon.web.request_limits import BodyTooLargeError
from optodrive.daemon.web.static_files import add_page
from optodrive.daemon.web.stop_priority import InTurn, written
from optodrive.daemon.web.telemetry import RATE_HZ, EventStream, Telemetry
from optodrive.planning.effective_config import resolved_config
from optodrive.planning.feasibility import Fit
from optodrive.planning.limiter.limiter import Policy
from optodrive.planning.pipeline import chosen
from optodrive.planning.stimuli.pattern_registry import build_pattern, describe_patterns
from optodrive.planning.stimuli.sequence_file import parse_json, parse_sequence

Answer = dict[str, Any]
STATUS: tuple[tuple[type[OptodriveError], int], ...] = (
    (InputError, 422),
    (RefusedError, 409),
    (NotReadyError, 409),
    (BoardFaultError, 409),
    (LinkError, 503),
)
PlanId = Annotated[str, Path(max_length=40)]
DryRun = Annotated[bool, Query(description="plan and limit only; nothing moves")]
Newest = Annotated[bool, Query(description="take the place of everything that has not left for the board yet")]
Strict = Annotated[bool, Query(description="the same as policy=refuse")]
PolicyQuery = Annotated[Policy, Query(description="what becomes of a frame that a cap does not allow as it is")]

RateQuery = Annotated[float, Query(ge=1, le=60, description="looks at the display a second, while it is warm")]
FitQuery = Annotated[Fit, Query(description="what becomes of a sequence that does not fit on the beam as it is")]


def make_app(engine: Engine, door: Door) -> FastAPI:
    """The daemon's web application over a running engine."""
    display = engine.display
    guard = Middleware(Guard, door=door)
    telemetry = Telemetry(engine)
    app = FastAPI(
        generate_unique_id_function=lambda route: route.name,
        title="optodrive",
        version=__version__,
        middleware=[Middleware(InTurn), guard],
        responses=ERRORS,
        docs_url=None,
        redoc_url=None,
        lifespan=telemetry.while_served,
    )
    app.state.telemetry = telemetry
    _add_error_answers(app)
    add_page(app)

    @app.get("/v1/health")
    async def health() -> Answer:
        """Whether the daemon runs; needs no token."""
        return {"status": "ok", "version": __version__}

    @app.get("/v1/state")
    async def state() -> Answer:
        """The board, the link, the queue, the display's heat."""
        return engine.snapshot()

    @app.get("/metrics", response_class=PlainTextResponse)
    async def figures() -> PlainTextResponse:
        """Figures for Prometheus."""
        return PlainTextResponse(engine.metrics(), media_type=CONTENT_TYPE)

    @app.get("/v1/config")
    async def config() -> Answer:
        """The resolved configuration, as `optodrive config show --json`."""
        return resolved_config(display)

    @app.post("/v1/arm")
    async def arm() -> Answer:
        """Arm the board: its indicator is lit for at least two seconds before it emits."""
        return await _result(engine.arm())

    @app.post("/v1/disarm")
    async def disarm() -> Answer:
        """Disarm; also acknowledges a fault whose cause is gone."""
        return await _result(engine.disarm())

    @app.post("/v1/stop")
    async def stop() -> Answer:
        """Gate off now, everything queued dropped, board disarmed."""
        return await _result(engine.stop())

    @app.post(
        "/v1/plans",
        status_code=201,
        response_model=Answer,
        openapi_extra=json_body("FRAMES.json: frames and trains", SEQUENCE, SHOWN, True),
    )
    async def push(
        request: Request,
        dry_run: DryRun = False,
        strict: Strict = False,
        policy: PolicyQuery = "trim",
        newest: Newest = False,
        fit: FitQuery = "as_is",
    ) -> Response:
        """Plan frames and trains, and show them."""
        body = await request.body()
        policy = chosen(policy, strict)
        planned = engine.submit(
            lambda: parse_sequence(body, display.config, "body"), "push", dry_run, policy, fit, streamed=newest
        )
        return await written(await _shown(request, planned), 201)

    @app.websocket("/v1/stream")
    async def stream(socket: WebSocket, policy: PolicyQuery = "trim") -> None:
        """Frames in, the newest wins; what became of each out."""
        await LiveStream(engine, socket, policy, problem_of).run()

    @app.get("/v1/telemetry", status_code=200, response_class=EventStream, responses=EVENTS)
    async def watch(rate_hz: RateQuery = RATE_HZ) -> EventStream:
        """What happens now, as server-sent events until the caller leaves: state, display, pulses, budget, fault."""
        telemetry.check_room()
        return EventStream(telemetry.events(rate_hz))

    @app.get("/v1/plans/{plan_id}", response_model=Answer)
    async def plan(plan_id: PlanId, pulses: Annotated[bool, Query(description="list every pulse")] = True) -> Response:
        """One plan: what was planned, sent, executed."""
        return await written(engine.plan(plan_id, pulses))

    @app.delete("/v1/plans/{plan_id}")
    async def cancel(plan_id: PlanId) -> Answer:
        """Take a plan out of the queue, or end it dark when it runs; the board stays armed."""
        return await _result(engine.cancel(plan_id))

    @app.get("/v1/patterns")
    async def patterns() -> Answer:
        """The named patterns and their parameters."""
        return {"patterns": describe_patterns()}

    @app.post(
        "/v1/patterns/{name}",
        status_code=201,
        response_model=Answer,
        openapi_extra=json_body("the pattern's parameters", PARAMETERS, {}, False),
    )
    async def play(
        name: Annotated[str, Path(max_length=80, json_schema_extra=PATTERN_NAMES)],
        request: Request,
        dry_run: DryRun = False,
        strict: Strict = False,
        policy: PolicyQuery = "trim",
        fit: FitQuery = "as_is",
    ) -> Response:
        """Build a named pattern, plan it, show it."""
        body = await request.body()
        given = parse_json(body, "body") if body.strip() else {}
        if not isinstance(given, dict):
            raise InputError("body", given, "an object of the pattern's parameters")
        policy = chosen(policy, strict)
        planned = engine.submit(lambda: build_pattern(name, given, display.config), name, dry_run, policy, fit)
        return await written(await _shown(request, planned), 201)

    describe(app)
    return app


async def _shown(request: Request, future: "Future[Answer]") -> Answer:
    """What was planned, told to the audit file too."""
    answer = await _result(future)
    keys = {"plan": "plan", "name": "pattern", "planned": "pulses", "status": "plan_status"}
    request.scope[FACTS].update({named: answer[key] for key, named in keys.items() if key in answer})
    return answer


async def _result(future: "Future[Answer]") -> Answer:
    return await asyncio.wrap_future(future)


def problem_of(error: OptodriveError) -> Answer:
    """An error as a problem document."""
    status = next((status for kind, status in STATUS if isinstance(error, kind)), 500)
    if error.code in ("no_plan", "unknown_pattern"):
        status = 404
    more: Answer = {}
    if isinstance(error, InputError):
        more = {"where": error.where, "value": abbreviate(error.value), "expected": error.expected}
    if isinstance(error, OverBudgetError):
        later_s = error.earliest_s if error.earliest_s < inf else None
        more = {"pixel": error.pixel, "cap": error.cap, "margin_j": error.margin_j, "fits_later_s": later_s}
    if isinstance(error, RefusedError) and error.admission is not None:
        more["admission"] = error.admission
    return problem(status, error.code, type(error).__name__.removesuffix("Error"), str(error), **more)


def _add_error_answers(app: FastAPI) -> None:
    def answer(document: dict[str, object]) -> JSONResponse:
        status = document["status"]
        return JSONResponse(document, status_code=int(str(status)), media_type="application/problem+json")

    def on(kind: type[Exception]) -> Callable[[Callable[[Request, Any], Awaitable[JSONResponse]]], None]:
        return lambda handler: app.add_exception_handler(kind, handler)

    @on(OptodriveError)
    async def _known(request: Request, error: OptodriveError) -> JSONResponse:
        return answer(problem_of(error))

    @on(RequestValidationError)
    async def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return answer(problem(422, "bad_input", "Bad input", f"{where}: {first['msg']}", where=where))

    @on(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        code = {404: "no_such_route", 405: "method_not_allowed"}.get(error.status_code, "http")
        return answer(problem(error.status_code, code, str(error.detail), f"{request.method} {request.url.path}"))

    @on(BodyTooLargeError)
    async def _too_large(request: Request, error: BodyTooLargeError) -> JSONResponse:
        return answer(problem(413, "body_too_large", "Body too large", "the body grew past its bound"))
