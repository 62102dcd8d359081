"""A display, driven from Python."""

import time
from base64 import b64encode
from collections.abc import Mapping
from html import escape
from types import TracebackType
from typing import Any, Self

import numpy as np

from optodrive.client.answers import Plan, State
from optodrive.client.heights import HeightsLike, build_layout, convert_to_pixels
from optodrive.client.http import DEFAULT_URL, DaemonClient, JsonObject
from optodrive.client.requests import (
    ApiRequest,
    Fit,
    Policy,
    build_frame_body,
    build_plan_path,
    build_play_request,
    build_push_request,
)
from optodrive.client.stream import Stream
from optodrive.core.errors import OptodriveError
from optodrive.device.config import PixelLayout

POLL_PERIOD_S = 0.03
RECONNECT_TIMEOUT_S = 5.0


class Display:
    """A display behind a running daemon, for `with`: whatever ends the block, what this caller lit is stopped.

    token: else OPTODRIVE_TOKEN, else the file the daemon wrote. patience_s: how long a daemon that has gone, once it
    has answered, is asked again. Nothing here ever arms but `arm`: a daemon that comes back is found DISARMED.
    Whoever only looks (state, preview, patterns, …) stops nobody.
    """

    def __init__(
        self, url: str = DEFAULT_URL, token: str | None = None, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        self._client = DaemonClient(url, token, reconnect_timeout_s)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._layout: PixelLayout | None = None
        self._last_plan: Plan | None = None
        self._may_emit = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._may_emit:
                self.stop()
        except OptodriveError as stop_error:
            if error is None:
                raise
            error.add_note(f"optodrive: {stop_error}")  # what the block raised is not to be lost for it
        finally:
            self.close()

    def close(self) -> None:
        """Close the connections, and stop nothing."""
        self._client.close()

    # --- the board ----------------------------------------------------------------------------------------------

    def arm(self) -> State:
        """Arm the board, deliberately; its indicator is lit for two seconds first. NotReadyError, BoardFaultError."""
        self._may_emit = True
        return State.from_response(self._client.call("POST", "/v1/arm"))

    def disarm(self) -> State:
        """Disarm; also acknowledges a fault whose cause is gone."""
        return State.from_response(self._client.call("POST", "/v1/disarm"))

    def stop(self) -> State:
        """Gate off now, everything dropped, board disarmed; LinkError where that was not heard."""
        state = State.from_response(self._client.stop())
        self._may_emit = False
        return state

    def state(self) -> State:
        """The board, the link, the queue."""
        return State.from_response(self._client.call("GET", "/v1/state"))

    def config(self) -> JsonObject:
        """The daemon's configuration, with everything derived from it."""
        return self._client.call("GET", "/v1/config")

    @property
    def layout(self) -> PixelLayout:
        """Where the pixels lie: x_m, y_m, row, column, all [p]; rows from the bottom."""
        if self._layout is None:
            self._layout = build_layout(self.config())
        return self._layout

    # --- showing ------------------------------------------------------------------------------------------------

    def show(
        self,
        heights_um: HeightsLike,
        duration_s: float = 1.0,
        *,
        simultaneous: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
        wait: bool = True,
    ) -> Plan:
        """Let each pixel rise once to its height, within duration_s; waits until it was shown, if not told otherwise.

        heights_um: {pixel: height}, [p] by pixel, or [rows, columns] by place, row 0 at the bottom (what is said of
        places without a pixel is passed over)
        """
        body = build_frame_body(convert_to_pixels(heights_um, self.layout), duration_s, simultaneous)
        return self.push(body, policy=policy, fit=fit, wait=wait)

    def push(
        self, sequence: Mapping[str, Any], *, policy: Policy = "trim", fit: Fit = "as_is", wait: bool = True
    ) -> Plan:
        """Show frames and trains as FRAMES.json has them."""
        return self._submit_and_wait(build_push_request(sequence, policy, fit, dry_run=False), wait)

    def play(
        self,
        name: str,
        *,
        policy: Policy = "trim",
        fit: Fit = "as_is",
        dry_run: bool = False,
        wait: bool = True,
        **parameters: Any,
    ) -> Plan:
        """Play a named pattern: its name, and its parameters by name. dry_run: plan only."""
        request = build_play_request(name, parameters, policy, fit, dry_run)
        return self._submit(request) if dry_run else self._submit_and_wait(request, wait)

    def preview(
        self,
        heights_um: HeightsLike,
        duration_s: float = 1.0,
        *,
        simultaneous: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
    ) -> Plan:
        """What `show` would do: planned and limited, nothing moves."""
        body = build_frame_body(convert_to_pixels(heights_um, self.layout), duration_s, simultaneous)
        return self._submit(build_push_request(body, policy, fit, dry_run=True))

    def stream(self, policy: Policy = "trim") -> Stream:
        """Frames that keep coming, the newest wins: `with display.stream() as stream: stream.send(heights_um)`."""
        return Stream(self._client.endpoint, self.layout, policy, self._reconnect_timeout_s, self._record_emission)

    def patterns(self) -> list[dict[str, Any]]:
        """The named patterns and their parameters."""
        patterns: list[dict[str, Any]] = self._client.call("GET", "/v1/patterns")["patterns"]
        return patterns

    # --- plans --------------------------------------------------------------------------------------------------

    def plan(self, plan: Plan | str) -> Plan:
        """A plan as it stands now."""
        return self._record_plan(self._client.call("GET", build_plan_path(_get_plan_id(plan))))

    def cancel(self, plan: Plan | str) -> Plan:
        """Take a plan out of the queue, or end it dark; the board stays armed."""
        return self._record_plan(self._client.call("DELETE", build_plan_path(_get_plan_id(plan))))

    def wait(self, plan: Plan | str) -> Plan:
        """A plan once it has ended; RefusedError where it failed."""
        path = build_plan_path(_get_plan_id(plan))
        while self._client.call("GET", path, params={"pulses": False})["status"] in ("queued", "running"):
            time.sleep(POLL_PERIOD_S)
        return self.plan(plan).raise_if_failed()

    def _submit(self, request: ApiRequest) -> Plan:
        return self._record_plan(
            self._client.call(request.method, request.path, request.idempotent, **request.arguments)
        )

    def _submit_and_wait(self, request: ApiRequest, wait: bool) -> Plan:
        self._record_emission()
        plan = self._submit(request)
        return self.wait(plan) if wait else plan

    def _record_plan(self, answer: JsonObject) -> Plan:
        self._last_plan = Plan.from_response(answer, self.layout)
        return self._last_plan

    def _record_emission(self) -> None:
        # Before it is sent: an answer that is lost may have lit something.
        self._may_emit = True

    # --- notebooks ----------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"<Display at {self._client.endpoint.url}>"

    def _repr_png_(self) -> bytes | None:
        from optodrive.client.picture import render_png

        try:
            layout = self.layout
        except OptodriveError:
            return None
        heights_um = None if self._last_plan is None else self._last_plan.heights_um
        return render_png(layout, np.zeros(len(layout)) if heights_um is None else heights_um)

    def _repr_html_(self) -> str:
        try:
            state = self.state()
        except OptodriveError as error:
            return f"<p>{escape(repr(self))}: {escape(str(error))}</p>"
        parts = [state.display, f"{state.pixels} pixels", state.board, f"link {state.link}"]
        if state.fault:
            parts.append(f"{state.fault}: {state.hint}")
        caption = "nothing shown yet" if self._last_plan is None else repr(self._last_plan)
        picture = b64encode(self._repr_png_() or b"").decode()
        return (
            f"<p>{escape(', '.join(parts))}<br>{escape(caption)}</p>"
            f'<img alt="heights of {escape(caption)}" src="data:image/png;base64,{picture}">'
        )


def _get_plan_id(plan: Plan | str) -> str:
    return plan if isinstance(plan, str) else plan.plan_id
