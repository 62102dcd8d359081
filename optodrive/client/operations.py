"""The operations of a display as exchanges, stated once for `Display` and `AsyncDisplay`."""

from collections.abc import Mapping
from typing import Any

from optodrive.client.exchange import Exchange, ExchangePolicy, Pause
from optodrive.client.heights import HeightsLike, convert_to_pixels
from optodrive.client.plan import Plan, report_loss
from optodrive.client.requests import (
    ARM,
    DISARM,
    LIST_PATTERNS,
    PAUSE,
    READ_CONFIG,
    READ_STATE,
    RESUME,
    ApiRequest,
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
LabelsLike = Mapping[str, str | int | float | bool] | None
"""Labels of a plan, None for those of its body."""


class DisplayOperations:
    """Operations of one display.

    may_emit: whether this client has armed the board or submitted a plan since the last stop
    last_plan: the plan that was reported last
    """

    def __init__(self, policy: ExchangePolicy) -> None:
        self.may_emit = False
        self.last_plan: Plan | None = None
        self._policy = policy
        self._layout: PixelLayout | None = None

    def arm(self) -> Exchange[StateReport]:
        """Arm the board unless it is armed already."""
        self.may_emit = True
        try:
            return (yield from self._policy.call(ARM))
        except NotReadyError:
            state = yield from self.read_state()
            if not state.board.is_armed:
                raise
            return state

    def disarm(self) -> Exchange[StateReport]:
        """Disarm the board."""
        return (yield from self._policy.call(DISARM))

    def dim(self, share: float) -> Exchange[StateReport]:
        """Cap the power of plans."""
        return (yield from self._policy.call(build_dim_request(share)))

    def pause(self) -> Exchange[StateReport]:
        """Pause the light."""
        return (yield from self._policy.call(PAUSE))

    def resume(self) -> Exchange[StateReport]:
        """Resume the light, which this client must then stop when it leaves."""
        self.may_emit = True
        return (yield from self._policy.call(RESUME))

    def stop(self) -> Exchange[StateReport]:
        """Stop the board."""
        state = yield from self._policy.stop()
        self.may_emit = False
        return state

    def read_state(self) -> Exchange[StateReport]:
        """Read the daemon's state."""
        return (yield from self._policy.call(READ_STATE))

    def read_config(self) -> Exchange[EffectiveConfig]:
        """Read the daemon's configuration."""
        return (yield from self._policy.call(READ_CONFIG))

    def read_layout(self) -> Exchange[PixelLayout]:
        """Return the layout of the pixels. Read it from the configuration once."""
        if self._layout is None:
            config = yield from self.read_config()
            self._layout = build_pixel_layout(config.display)
        return self._layout

    def list_patterns(self) -> Exchange[list[PatternDescription]]:
        """List the named patterns."""
        return (yield from self._policy.call(LIST_PATTERNS)).patterns

    def show(
        self,
        heights_um: HeightsLike,
        duration_s: float,
        simultaneous: bool,
        options: PushOptions,
        dry_run: bool,
        wait: bool,
        labels: LabelsLike = None,
    ) -> Exchange[Plan]:
        """Plan one frame, and show it unless `dry_run`."""
        layout = yield from self.read_layout()
        body = build_frame_body(convert_to_pixels(heights_um, layout), duration_s, simultaneous)
        return (yield from self.push(body, options, dry_run, wait, labels))

    def push(
        self,
        sequence: Mapping[str, Any],
        options: PushOptions,
        dry_run: bool,
        wait: bool,
        labels: LabelsLike = None,
    ) -> Exchange[Plan]:
        """Plan frames and trains, and show them unless `dry_run`."""
        body = _add_labels(sequence, labels)
        return (yield from self._submit(build_push_request(body, options, dry_run), dry_run, wait))

    def play(
        self,
        name: str,
        parameters: dict[str, Any],
        dry_run: bool,
        wait: bool,
        labels: LabelsLike = None,
    ) -> Exchange[Plan]:
        """Plan a named pattern, and show it unless `dry_run`.

        parameters: of the pattern, together with the options of the push
        """
        options = select_push_options(parameters)
        body = _add_labels(parameters, labels)
        return (yield from self._submit(build_play_request(name, body, options, dry_run), dry_run, wait))

    def read_plan(self, plan: Plan | str) -> Exchange[Plan]:
        """Read a plan."""
        return (yield from self._report(build_read_request(_get_plan_id(plan))))

    def cancel_plan(self, plan: Plan | str) -> Exchange[Plan]:
        """Cancel a plan."""
        return (yield from self._report(build_cancel_request(_get_plan_id(plan))))

    def wait_for_plan(self, plan: Plan | str) -> Exchange[Plan]:
        """Wait until a plan has ended. Raise RefusedError if it failed or was stopped."""
        poll = build_read_request(_get_plan_id(plan), pulses=False)
        while not (yield from self._policy.call(poll)).has_ended:
            yield Pause(POLL_PERIOD_S)
        return (yield from self.read_plan(plan)).raise_if_failed()

    def _submit(self, request: ApiRequest[Plan], dry_run: bool, wait: bool) -> Exchange[Plan]:
        if dry_run:
            return (yield from self._report(request))
        self.may_emit = True  # before the request: its effect is unknown if the response is lost
        plan = yield from self._report(request)
        if not wait:
            return plan
        with report_loss(plan.plan):
            return (yield from self.wait_for_plan(plan))

    def _report(self, request: ApiRequest[Plan]) -> Exchange[Plan]:
        plan = yield from self._policy.call(request)
        self.last_plan = plan.place_on((yield from self.read_layout()))
        return self.last_plan


def _add_labels(body: Mapping[str, Any], labels: LabelsLike) -> Mapping[str, Any]:
    """Return the body with labels, which replace its own."""
    return body if labels is None else {**body, "labels": dict(labels)}


def _get_plan_id(plan: Plan | str) -> str:
    return plan if isinstance(plan, str) else plan.plan
