"""A display, controlled from Python."""

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from types import TracebackType
from typing import Any, Self, Unpack

import numpy as np

from optodrive.client.heights import HeightsLike
from optodrive.client.hold import Hold
from optodrive.client.http import DaemonClient
from optodrive.client.operations import DisplayOperations, LabelsLike
from optodrive.client.plan import Plan
from optodrive.client.stream import Stream
from optodrive.core.daemon_url import read_default_url
from optodrive.core.errors import OptodriveError
from optodrive.core.types.push_options import Policy, PushOptions
from optodrive.daemon.responses.state import StateReport
from optodrive.device.config import PixelLayout
from optodrive.planning.effective_config import EffectiveConfig
from optodrive.planning.stimuli.pattern import PatternDescription

RECONNECT_TIMEOUT_S = 2.5


class Display:
    """A display behind a running daemon, as a context manager that stops everything that this client started.

    url: if None, OPTODRIVE_URL, else http://127.0.0.1:8450
    token: if None, OPTODRIVE_TOKEN, else the file that the daemon wrote
    reconnect_timeout_s: how long requests to a daemon that has responded before are repeated if it is unreachable

    Only `arm` arms; a restarted daemon has a DISARMED board. A client that only reads (state, preview, patterns, …)
    stops nothing.
    """

    def __init__(
        self, url: str | None = None, token: str | None = None, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        self._client = DaemonClient(url or read_default_url(), token, reconnect_timeout_s)
        self._operations = DisplayOperations(self._client.policy)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._hold: Hold | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._operations.may_emit:
                self.stop()
        except OptodriveError as stop_error:
            if error is None:
                raise
            error.add_note(f"optodrive: {stop_error}")  # the block's own exception takes precedence
        finally:
            self.close()

    def close(self) -> None:
        """Close the connections without stopping anything, but for an arming that they hold. Only `stop` works then."""
        if self._hold is not None:
            self._hold.close()
        self._client.close()

    # --- the board ----------------------------------------------------------------------------------------------

    def arm(self, *, hold: bool = False) -> StateReport:
        """Arm the board unless it is armed. Its indicator is on for two seconds first.

        hold: the board disarms, dark, when this display is closed, or when its process ends or stops for a second; a
        board that is armed already is refused. Raises NotReadyError or BoardFaultError.
        """
        if not hold:
            return self._client.run(self._operations.arm())
        self._record_emission()
        self._hold = Hold(self._client.policy.endpoint)
        return self.state()

    def disarm(self) -> StateReport:
        """Disarm the board. This also acknowledges a fault whose cause is gone."""
        return self._client.run(self._operations.disarm())

    def dim(self, share: float) -> StateReport:
        """Cap the power of every pulse of the plans from now on, as a share of the laser's, 0 to 1.

        It stays when this client leaves. Only an armer may raise it again; RefusedError for others.
        """
        return self._client.run(self._operations.dim(share))

    def pause(self) -> StateReport:
        """Switch the gate off and keep the board armed and all plans, for five minutes at most. Then it is disarmed.

        Streamed frames are refused meanwhile. NotReadyError if the board is not armed.
        """
        return self._client.run(self._operations.pause())

    def resume(self) -> StateReport:
        """Play the rest of the paused plan, limited again, and the plans that wait.

        NotReadyError if the board is not armed.
        """
        return self._client.run(self._operations.resume())

    def stop(self) -> StateReport:
        """Switch the gate off, drop all plans, disarm the board. Raise LinkError if no answer confirms it."""
        return self._client.run(self._operations.stop())

    def state(self) -> StateReport:
        """Return the state of board, link and queue."""
        return self._client.run(self._operations.read_state())

    def config(self) -> EffectiveConfig:
        """Return the daemon's configuration with everything derived from it."""
        return self._client.run(self._operations.read_config())

    @property
    def layout(self) -> PixelLayout:
        """The positions of the pixels: x_m, y_m, row, column, all [p]. Rows count from the bottom."""
        return self._client.run(self._operations.read_layout())

    # --- showing ------------------------------------------------------------------------------------------------

    def show(
        self,
        heights_um: HeightsLike,
        duration_s: float = 1.0,
        *,
        simultaneous: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """Raise each pixel once to its height within duration_s. Wait until that is done unless `wait` is False.

        heights_um: {pixel: height}, [p] by pixel, or [rows, columns] by position, row 0 at the bottom (values at
        positions without a pixel are ignored)
        labels: recorded with the plan: at most 32 of text, numbers and truth values
        options: `policy` and `fit`, as PushOptions describes them
        """
        operation = self._operations.show(heights_um, duration_s, simultaneous, options, False, wait, labels)
        return self._client.run(operation)

    def push(
        self,
        sequence: Mapping[str, Any],
        *,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """Show frames and trains in the form of FRAMES.json."""
        return self._client.run(self._operations.push(sequence, options, False, wait, labels))

    def play(
        self,
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
        return self._client.run(self._operations.play(name, parameters, dry_run, wait, labels))

    def preview(
        self,
        heights_um: HeightsLike,
        duration_s: float = 1.0,
        *,
        simultaneous: bool = False,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """Plan a frame as `show` would. Nothing moves."""
        operation = self._operations.show(heights_um, duration_s, simultaneous, options, True, False)
        return self._client.run(operation)

    def stream(self, policy: Policy = "trim") -> Stream:
        """Open a stream of frames, of which the newest wins: `with display.stream() as stream: stream.send(…)`."""
        self._client.require_open()
        return Stream(
            self._client.policy.endpoint, self.layout, policy, self._reconnect_timeout_s, self._record_emission
        )

    def patterns(self) -> list[PatternDescription]:
        """Return the named patterns and their parameters."""
        return self._client.run(self._operations.list_patterns())

    # --- plans --------------------------------------------------------------------------------------------------

    def plan(self, plan: Plan | str) -> Plan:
        """Return a plan's present report."""
        return self._client.run(self._operations.read_plan(plan))

    def cancel(self, plan: Plan | str) -> Plan:
        """Remove a plan from the queue, or end it if it runs. The board stays armed."""
        return self._client.run(self._operations.cancel_plan(plan))

    def wait(self, plan: Plan | str) -> Plan:
        """Wait until a plan has ended and return it. Raise RefusedError if it failed."""
        return self._client.run(self._operations.wait_for_plan(plan))

    def _record_emission(self) -> None:
        self._client.require_open()
        self._operations.may_emit = True

    # --- notebooks ----------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"<Display at {self._client.policy.endpoint.url}>"

    def _repr_png_(self) -> bytes | None:
        from optodrive.client.picture import render_png

        try:
            layout = self.layout
        except OptodriveError:
            return None
        plan = self._operations.last_plan
        heights_um = None if plan is None else plan.heights_um
        return render_png(layout, np.zeros(len(layout)) if heights_um is None else heights_um)

    def _repr_html_(self) -> str:
        try:
            state = self.state()
        except OptodriveError as error:
            return f"<p>{escape(repr(self))}: {escape(str(error))}</p>"
        board, plan = state.board, self._operations.last_plan
        parts = [state.display, f"{state.pixels} pixels", board.state, f"link {state.link.state}"]
        if board.fault:
            parts.append(f"{board.fault}: {board.hint}")
        caption = "nothing shown yet" if plan is None else repr(plan)
        picture = b64encode(self._repr_png_() or b"").decode()
        return (
            f"<p>{escape(', '.join(parts))}<br>{escape(caption)}</p>"
            f'<img alt="heights of {escape(caption)}" src="data:image/png;base64,{picture}">'
        )
