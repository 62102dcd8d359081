"""A display, driven from Python."""

import time
from base64 import b64encode
from collections.abc import Mapping
from html import escape
from types import TracebackType
from typing import Any, Self

import numpy as np

from optodrive.client.answers import Plan, State
from optodrive.client.heights import Heights, by_pixel, layout_of
from optodrive.client.http import DEFAULT_URL, Answer, Remote
from optodrive.client.requests import Fit, Order, Policy, frame_body, plan_path, play_order, push_order
from optodrive.client.stream import Stream
from optodrive.core.errors import OptodriveError
from optodrive.device.config import PixelLayout

POLL_S = 0.03
PATIENCE_S = 5.0


class Display:
    """A display behind a running daemon, for `with`: whatever ends the block, what this caller lit is stopped.

    token: else OPTODRIVE_TOKEN, else the file the daemon wrote. patience_s: how long a daemon that has gone, once it
    has answered, is asked again. Nothing here ever arms but `arm`: a daemon that comes back is found DISARMED.
    Whoever only looks (state, preview, patterns, …) stops nobody.
    """

    def __init__(self, url: str = DEFAULT_URL, token: str | None = None, patience_s: float = PATIENCE_S) -> None:
        self._remote = Remote(url, token, patience_s)
        self._patience_s = patience_s
        self._layout: PixelLayout | None = None
        self._last: Plan | None = None
        self._may_be_lit = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._may_be_lit:
                self.stop()
        except OptodriveError as trouble:
            if error is None:
                raise
            error.add_note(f"optodrive: {trouble}")  # what the block raised is not to be lost for it
        finally:
            self.close()

    def close(self) -> None:
        """Close the connections, and stop nothing."""
        self._remote.close()

    # --- the board ----------------------------------------------------------------------------------------------

    def arm(self) -> State:
        """Arm the board, deliberately; its indicator is lit for two seconds first. NotReadyError, BoardFaultError."""
        self._may_be_lit = True
        return State.of(self._remote.call("POST", "/v1/arm"))

    def disarm(self) -> State:
        """Disarm; also acknowledges a fault whose cause is gone."""
        return State.of(self._remote.call("POST", "/v1/disarm"))

    def stop(self) -> State:
        """Gate off now, everything dropped, board disarmed; LinkError where that was not heard."""
        state = State.of(self._remote.stop())
        self._may_be_lit = False
        return state

    def state(self) -> State:
        """The board, the link, the queue."""
        return State.of(self._remote.call("GET", "/v1/state"))

    def config(self) -> Answer:
        """The daemon's configuration, with everything derived from it."""
        return self._remote.call("GET", "/v1/config")

    @property
    def layout(self) -> PixelLayout:
        """Where the pixels lie: x_m, y_m, row, column, all [p]; rows from the bottom."""
        if self._layout is None:
            self._layout = layout_of(self.config())
        return self._layout

    # --- showing ------------------------------------------------------------------------------------------------

    def show(
        self,
        heights_um: Heights,
        duration_s: float = 1.0,
        *,
        together: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
        wait: bool = True,
    ) -> Plan:
        """Let each pixel rise once to its height, within duration_s; waits until it was shown, if not told otherwise.

        heights_um: {pixel: height}, [p] by pixel, or [rows, columns] by place, row 0 at the bottom (what is said of
        places without a pixel is passed over)
        """
        body = frame_body(by_pixel(heights_um, self.layout), duration_s, together)
        return self.push(body, policy=policy, fit=fit, wait=wait)

    def push(
        self, sequence: Mapping[str, Any], *, policy: Policy = "trim", fit: Fit = "as_is", wait: bool = True
    ) -> Plan:
        """Show frames and trains as FRAMES.json has them."""
        return self._shown(push_order(sequence, policy, fit, dry_run=False), wait)

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
        order = play_order(name, parameters, policy, fit, dry_run)
        return self._planned(order) if dry_run else self._shown(order, wait)

    def preview(
        self,
        heights_um: Heights,
        duration_s: float = 1.0,
        *,
        together: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
    ) -> Plan:
        """What `show` would do: planned and limited, nothing moves."""
        body = frame_body(by_pixel(heights_um, self.layout), duration_s, together)
        return self._planned(push_order(body, policy, fit, dry_run=True))

    def stream(self, policy: Policy = "trim") -> Stream:
        """Frames that keep coming, the newest wins: `with display.stream() as stream: stream.send(heights_um)`."""
        return Stream(self._remote.access, self.layout, policy, self._patience_s, self._note_light)

    def patterns(self) -> list[dict[str, Any]]:
        """The named patterns and their parameters."""
        found: list[dict[str, Any]] = self._remote.call("GET", "/v1/patterns")["patterns"]
        return found

    # --- plans --------------------------------------------------------------------------------------------------

    def plan(self, plan: Plan | str) -> Plan:
        """A plan as it stands now."""
        return self._remember(self._remote.call("GET", plan_path(_id(plan))))

    def cancel(self, plan: Plan | str) -> Plan:
        """Take a plan out of the queue, or end it dark; the board stays armed."""
        return self._remember(self._remote.call("DELETE", plan_path(_id(plan))))

    def wait(self, plan: Plan | str) -> Plan:
        """A plan once it has ended; RefusedError where it failed."""
        path = plan_path(_id(plan))
        while self._remote.call("GET", path, params={"pulses": False})["status"] in ("queued", "running"):
            time.sleep(POLL_S)
        return self.plan(plan).checked()

    def _planned(self, order: Order) -> Plan:
        return self._remember(self._remote.call(order.method, order.path, order.safe, **order.request))

    def _shown(self, order: Order, wait: bool) -> Plan:
        self._note_light()
        plan = self._planned(order)
        return self.wait(plan) if wait else plan

    def _remember(self, answer: Answer) -> Plan:
        self._last = Plan.of(answer, self.layout)
        return self._last

    def _note_light(self) -> None:
        # Before it is sent: an answer that is lost may have lit something.
        self._may_be_lit = True

    # --- notebooks ----------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"<Display at {self._remote.access.url}>"

    def _repr_png_(self) -> bytes | None:
        from optodrive.client.picture import png

        try:
            layout = self.layout
        except OptodriveError:
            return None
        heights_um = None if self._last is None else self._last.heights_um
        return png(layout, np.zeros(len(layout)) if heights_um is None else heights_um)

    def _repr_html_(self) -> str:
        try:
            state = self.state()
        except OptodriveError as error:
            return f"<p>{escape(repr(self))}: {escape(str(error))}</p>"
        words = [state.display, f"{state.pixels} pixels", state.board, f"link {state.link}"]
        if state.fault:
            words.append(f"{state.fault}: {state.hint}")
        what = "nothing shown yet" if self._last is None else repr(self._last)
        picture = b64encode(self._repr_png_() or b"").decode()
        return (
            f"<p>{escape(', '.join(words))}<br>{escape(what)}</p>"
            f'<img alt="heights of {escape(what)}" src="data:image/png;base64,{picture}">'
        )


def _id(plan: Plan | str) -> str:
    return plan if isinstance(plan, str) else plan.plan_id
