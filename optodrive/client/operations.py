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
from optodrive.core.errors import NotReadyError
from optodrive.core.types.push_options import PushOptions, select_push_options
from optodrive.daemon.responses.state import StateReport
from optodrive.device.config import PixelLayout, build_pixel_layout
from optodrive.planning.effective_config import EffectiveConfig
from optodrive.planning.stimuli.pattern import PatternDescription

POLL_PERIOD_S = 0.03
RECONNECT_TIMEOUT_S = 2.5
LabelsLike = Mapping[str, str | int | float | bool] | None
"""Labels of a plan, None for those of its body."""


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
        """Arm the board unless it is armed already."""
        self.may_emit = True
        try:
            return await self._policy.call(ARM)
        except NotReadyError:
            state = await self.state()
            if not state.board.is_armed:
                raise
            return state

    async def disarm(self) -> StateReport:
        """Disarm the board. This also acknowledges a fault whose cause is gone."""
        return await self._policy.call(DISARM)

    async def dim(self, share: float) -> StateReport:
        """Cap the power of every pulse of the plans from now on, as a share of the laser's, 0 to 1.

        It stays when this client leaves. Only an armer may raise it again; RefusedError for others.
        """
        return await self._policy.call(build_dim_request(share))

    async def pause(self) -> StateReport:
        """Switch the gate off and keep the board armed and all plans, for five minutes at most. Then it is disarmed.

        Streamed frames are refused meanwhile. NotReadyError if the board is not armed.
        """
        return await self._policy.call(PAUSE)

    async def resume(self) -> StateReport:
        """Play the rest of the paused plan, limited again, and the plans that wait.

        NotReadyError if the board is not armed.
        """
        self.may_emit = True
        return await self._policy.call(RESUME)

    async def stop(self) -> StateReport:
        """Switch the gate off, drop all plans, disarm the board. Raise LinkError if no answer confirms it."""
        state = await self._policy.stop(STOP)
        self.may_emit = False
        return state

    async def state(self) -> StateReport:
        """Return the state of board, link and queue."""
        return await self._policy.call(READ_STATE)

    async def config(self) -> EffectiveConfig:
        """Return the daemon's configuration with everything derived from it."""
        return await self._policy.call(READ_CONFIG)

    async def layout(self) -> PixelLayout:
        """Return the positions of the pixels: x_m, y_m, row, column, all [p]. Rows count from the bottom."""
        if self._layout is None:
            self._layout = build_pixel_layout((await self.config()).display)
        return self._layout

    async def patterns(self) -> list[PatternDescription]:
        """Return the named patterns and their parameters."""
        return (await self._policy.call(LIST_PATTERNS)).patterns

    async def show(
        self,
        heights_um: HeightsLike | None = None,
        duration_s: float = 1.0,
        *,
        intensity: HeightsLike | None = None,
        simultaneous: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """Raise each pixel once to its height within duration_s. Wait until that is done unless `wait` is False.

        heights_um: {pixel: height}, [p] by pixel, or [rows, columns] by position, row 0 at the bottom (values at
        positions without a pixel are ignored)
        intensity: in the same forms, the perceived intensity in thresholds, in place of heights_um
        labels: recorded with the plan: at most 32 of text, numbers and truth values
        options: `policy` and `fit`, as PushOptions describes them
        """
        target = encode_target(heights_um, intensity, await self.layout())
        body = build_frame_body(target, duration_s, simultaneous)
        return await self.push(body, wait=wait, labels=labels, **options)

    async def push(
        self,
        sequence: Mapping[str, Any],
        *,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """Show frames and trains in the form of FRAMES.json."""
        return await self._submit(build_push_request(_add_labels(sequence, labels), options, dry_run=False), wait)

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
        """Play a named pattern with its parameters by name.

        dry_run: plan only; parameters: of the pattern, together with the options of `show`
        """
        options = select_push_options(parameters)
        request = build_play_request(name, _add_labels(parameters, labels), options, dry_run)
        return await (self._report(request) if dry_run else self._submit(request, wait))

    async def preview(
        self,
        heights_um: HeightsLike | None = None,
        duration_s: float = 1.0,
        *,
        intensity: HeightsLike | None = None,
        simultaneous: bool = False,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """Plan a frame as `show` would. Nothing moves."""
        target = encode_target(heights_um, intensity, await self.layout())
        body = build_frame_body(target, duration_s, simultaneous)
        return await self._report(build_push_request(body, options, dry_run=True))

    async def plan(self, plan: Plan | str) -> Plan:
        """Return a plan's present report."""
        return await self._report(build_read_request(_get_plan_id(plan)))

    async def cancel(self, plan: Plan | str) -> Plan:
        """Remove a plan from the queue, or end it if it runs. The board stays armed."""
        return await self._report(build_cancel_request(_get_plan_id(plan)))

    async def wait(self, plan: Plan | str) -> Plan:
        """Wait until a plan has ended and return it. Raise RefusedError if it failed or was stopped."""
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


def _get_plan_id(plan: Plan | str) -> str:
    return plan if isinstance(plan, str) else plan.plan
