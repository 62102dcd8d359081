"""The operations of a display as coroutines, stated once for `Display` and `AsyncDisplay`."""

from collections.abc import Mapping
from typing import Any, Unpack

from optodrive.client.api_request import ApiRequest
from optodrive.client.exchange import ExchangePolicy, HttpIo
from optodrive.client.heights import HeightsLike, encode_target
from optodrive.client.plan import Plan, report_loss
from optodrive.client.requests import (
    ARM,
    DISARM,
    LIST_PATTERNS,
    PAUSE,
    READ_CONFIG,
    READ_STATE,
    RESUME,
    STOP,
    build_cancel_request,
    build_dim_request,
    build_frame_body,
    build_play_request,
    build_push_request,
    build_read_request,
)
from optodrive.core.errors import InputError, NotReadyError, abbreviate, suggest_near_name
from optodrive.core.types.push_options import PushOptions, check_keywords, list_push_options, select_push_options
from optodrive.daemon.responses.state import StateReport
from optodrive.device.config import PixelLayout, build_pixel_layout
from optodrive.planning.effective_config import EffectiveConfig
from optodrive.planning.stimuli.pattern import PatternDescription

POLL_PERIOD_S = 0.03
RECONNECT_TIMEOUT_S = 2.5
LabelsLike = Mapping[str, str | int | float | bool] | None
"""Labels of a plan, None for those of its body."""


@check_keywords
class DisplayOperations:
    """Operations of one display.

    may_emit: whether this client has armed the board or submitted a plan since the last stop
    last_plan: the plan that was reported last
    """

    def __init__(self, http: HttpIo, reconnect_timeout_s: float) -> None:
        self.may_emit = False
        self.last_plan: Plan | None = None
        self._http = http
        self._policy = ExchangePolicy(http, reconnect_timeout_s)
        self._layout: PixelLayout | None = None

    async def arm(self) -> StateReport:
        """See `Display.arm`."""
        self.may_emit = True
        try:
            return await self._policy.call(ARM)
        except NotReadyError:
            state = await self.state()
            if not state.board.is_armed:
                raise
            return state

    async def disarm(self) -> StateReport:
        """See `Display.disarm`."""
        return await self._policy.call(DISARM)

    async def dim(self, share: float) -> StateReport:
        """See `Display.dim`."""
        return await self._policy.call(build_dim_request(share))

    async def pause(self) -> StateReport:
        """See `Display.pause`."""
        return await self._policy.call(PAUSE)

    async def resume(self) -> StateReport:
        """See `Display.resume`."""
        self.may_emit = True
        return await self._policy.call(RESUME)

    async def stop(self) -> StateReport:
        """See `Display.stop`."""
        state = await self._policy.stop(STOP)
        self.may_emit = False
        return state

    async def state(self) -> StateReport:
        """See `Display.state`."""
        return await self._policy.call(READ_STATE)

    async def config(self) -> EffectiveConfig:
        """See `Display.config`."""
        return await self._policy.call(READ_CONFIG)

    async def layout(self) -> PixelLayout:
        """See `Display.layout`."""
        if self._layout is None:
            self._layout = build_pixel_layout((await self.config()).display)
        return self._layout

    async def patterns(self) -> list[PatternDescription]:
        """See `Display.patterns`."""
        return (await self._policy.call(LIST_PATTERNS)).patterns

    async def show(
        self,
        heights_um: HeightsLike | None = None,
        duration_s: float = 1.0,
        *,
        intensity: HeightsLike | None = None,
        simultaneous: bool = False,
        dry_run: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """See `Display.show`."""
        target = encode_target(heights_um, intensity, await self.layout())
        body = build_frame_body(target, duration_s, simultaneous)
        return await self.push(body, dry_run=dry_run, wait=wait, labels=labels, **options)

    async def push(
        self,
        sequence: Mapping[str, Any],
        *,
        dry_run: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """See `Display.push`."""
        request = build_push_request(_add_labels(sequence, labels), options, dry_run)
        return await (self._report(request) if dry_run else self._submit(request, wait))

    async def play(
        self,
        /,
        name: str,
        *,
        dry_run: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **parameters: Any,
    ) -> Plan:
        """See `Display.play`."""
        options = select_push_options(parameters)
        request = build_play_request(name, _add_labels(parameters, labels), options, dry_run)
        try:
            return await (self._report(request) if dry_run else self._submit(request, wait))
        except InputError as error:
            if error.code == "unknown_parameter":
                raise _suggest_keyword(error, parameters) from None
            raise

    async def plan(self, plan: Plan | str) -> Plan:
        """See `Display.plan`."""
        return await self._report(build_read_request(_get_plan_id(plan)))

    async def cancel(self, plan: Plan | str) -> Plan:
        """See `Display.cancel`."""
        return await self._report(build_cancel_request(_get_plan_id(plan)))

    async def wait(self, plan: Plan | str) -> Plan:
        """See `Display.wait`."""
        poll = build_read_request(_get_plan_id(plan), pulses=False)
        while not (await self._policy.call(poll)).has_ended:
            await self._http.sleep(POLL_PERIOD_S)
        return (await self.plan(plan)).raise_if_failed()

    async def _submit(self, request: ApiRequest[Plan], wait: bool) -> Plan:
        self.may_emit = True  # before the request: its effect is unknown if the response is lost
        plan = await self._report(request)
        if not wait:
            return plan
        with report_loss(plan.plan):
            return await self.wait(plan)

    async def _report(self, request: ApiRequest[Plan]) -> Plan:
        plan = await self._policy.call(request)
        self.last_plan = plan.place_on(await self.layout())
        return self.last_plan


def _add_labels(body: Mapping[str, Any], labels: LabelsLike) -> Mapping[str, Any]:
    """Return the body with labels, which replace its own."""
    return body if labels is None else {**body, "labels": dict(labels)}


def _suggest_keyword(error: InputError, parameters: Mapping[str, Any]) -> InputError:
    """Return the error of a parameter that the pattern does not have, with the nearest keyword of `play` if any is."""
    keywords = ["dry_run", "wait", "labels", *(option.name for option in list_push_options())]
    unknown = next((name for name in parameters if abbreviate(name) == abbreviate(error.value)), "")
    near = suggest_near_name(unknown, keywords)
    expected = f"{error.expected}; of the keywords of play, {near}" if near else error.expected
    described = InputError(error.where, error.value, expected, error.code)
    described.problem = error.problem
    return described


def _get_plan_id(plan: Plan | str) -> str:
    return plan if isinstance(plan, str) else plan.plan
