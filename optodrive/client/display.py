"""A display, controlled from Python."""

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from types import TracebackType
from typing import Any, Self, Unpack

import numpy as np

from optodrive.client.exchange import Endpoint, run_blocking
from optodrive.client.fingers import Fingers
from optodrive.client.heights import HeightsLike, render_png
from optodrive.client.hold import Hold
from optodrive.client.http import BlockingHttp
from optodrive.client.operations import RECONNECT_TIMEOUT_S, DisplayOperations, LabelsLike
from optodrive.client.plan import Plan
from optodrive.client.stream import Stream
from optodrive.core.daemon_url import check_environment, read_default_url
from optodrive.core.errors import OptodriveError
from optodrive.core.types.push_options import Policy, PushOptions, check_keywords
from optodrive.daemon.responses.state import StateReport
from optodrive.device.config import PixelLayout
from optodrive.planning.effective_config import EffectiveConfig
from optodrive.planning.stimuli.pattern import PatternDescription


@check_keywords
class Display:
    """A display behind a running daemon, as a context manager that stops everything that this client started.

    url: if None, OPTODRIVE_URL, else http://127.0.0.1:8450
    token: if None, OPTODRIVE_TOKEN, else the file that the daemon wrote
    reconnect_timeout_s: how long requests to a daemon that has responded before are repeated if it is unreachable

    Only `arm` arms; a restarted daemon has a DISARMED board. A client that only reads, or plans with dry_run,
    stops nothing.
    """

    def __init__(
        self, url: str | None = None, token: str | None = None, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        check_environment()
        self._client = BlockingHttp(Endpoint(url or read_default_url(), token))
        self._operations = DisplayOperations(self._client, reconnect_timeout_s)
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

    def arm(self, *, hold: bool = False) -> StateReport:
        """Arm the board unless it is armed. Its indicator is on for two seconds first.

        hold: the board disarms, dark, when this display is closed, or when its process ends or stops for a second; a
        board that is armed already is refused. Raises NotReadyError or BoardFaultError.
        """
        if not hold:
            return run_blocking(self._operations.arm())
        self._record_emission()
        self._hold = Hold(self._client.endpoint)
        return self.state()

    def disarm(self) -> StateReport:
        """Disarm the board. This also acknowledges a fault whose cause is gone."""
        return run_blocking(self._operations.disarm())

    def dim(self, share: float) -> StateReport:
        """Cap the power of every pulse of the plans from now on, as a share of the laser's, 0 to 1.

        It stays when this client leaves. Only an armer may raise it again; RefusedError for others.
        """
        return run_blocking(self._operations.dim(share))

    def pause(self) -> StateReport:
        """Switch the gate off and keep the board armed and all plans, for five minutes at most. Then it is disarmed.

        Streamed frames are refused meanwhile. NotReadyError if the board is not armed.
        """
        return run_blocking(self._operations.pause())

    def resume(self) -> StateReport:
        """Play the rest of the paused plan, limited again, and the plans that wait.

        NotReadyError if the board is not armed.
        """
        return run_blocking(self._operations.resume())

    def stop(self) -> StateReport:
        """Switch the gate off, drop all plans, disarm the board. Raise LinkError if no answer confirms it."""
        return run_blocking(self._operations.stop())

    def state(self) -> StateReport:
        """Return the state of board, link and queue."""
        return run_blocking(self._operations.state())

    def config(self) -> EffectiveConfig:
        """Return the daemon's configuration with everything derived from it."""
        return run_blocking(self._operations.config())

    @property
    def layout(self) -> PixelLayout:
        """The positions of the pixels: x_m, y_m, row, column, all [p]. Rows count from the bottom."""
        return run_blocking(self._operations.layout())

    def patterns(self) -> list[PatternDescription]:
        """Return the named patterns and their parameters."""
        return run_blocking(self._operations.patterns())

    def show(
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
        """Raise each pixel once to its height within duration_s. Wait until that is done unless `wait` is False.

        heights_um: {pixel: height}, [p] by pixel, or [rows, columns] by position, row 0 at the bottom (values at
        positions without a pixel are ignored)
        intensity: in the same forms, the perceived intensity in thresholds, in place of heights_um
        simultaneous: raise all pixels within one relaxation time
        dry_run: plan and limit only; nothing moves
        labels: recorded with the plan: at most 32 of text, numbers and truth values
        options: `policy` and `fit`, as PushOptions describes them

        Raises InputError, NotReadyError if the board is not armed, and RefusedError for a plan that fails.
        """
        return run_blocking(
            self._operations.show(
                heights_um,
                duration_s,
                intensity=intensity,
                simultaneous=simultaneous,
                dry_run=dry_run,
                wait=wait,
                labels=labels,
                **options,
            )
        )

    def push(
        self,
        sequence: Mapping[str, Any],
        *,
        dry_run: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **options: Unpack[PushOptions],
    ) -> Plan:
        """Show frames and trains in the form of FRAMES.json. The other arguments and errors are those of `show`."""
        return run_blocking(self._operations.push(sequence, dry_run=dry_run, wait=wait, labels=labels, **options))

    def play(
        self,
        /,
        name: str,
        *,
        dry_run: bool = False,
        wait: bool = True,
        labels: LabelsLike = None,
        **parameters: Any,
    ) -> Plan:
        """Play a named pattern with its parameters by name, as `patterns` lists them.

        parameters: of the pattern, together with `policy` and `fit`; the other arguments and errors are those of `show`
        """
        return run_blocking(self._operations.play(name, dry_run=dry_run, wait=wait, labels=labels, **parameters))

    def plan(self, plan: Plan | str) -> Plan:
        """Return a plan's present report."""
        return run_blocking(self._operations.plan(plan))

    def cancel(self, plan: Plan | str) -> Plan:
        """Remove a plan from the queue, or end it if it runs. The board stays armed."""
        return run_blocking(self._operations.cancel(plan))

    def wait(self, plan: Plan | str) -> Plan:
        """Wait until a plan has ended and return it. Raise RefusedError if it failed or was stopped."""
        return run_blocking(self._operations.wait(plan))

    def stream(self, policy: Policy = "trim", *, standing: bool = False, touched_only: bool = False) -> Stream:
        """Open a stream of frames, of which the newest wins: `with display.stream() as stream: stream.send(…)`.

        standing: refresh the newest frame until the next one, under fingers first
        touched_only: with `standing`, leave dots dark that no finger touches
        """
        self._client.require_open()
        endpoint, layout = self._client.endpoint, self.layout
        frames = (policy, standing, touched_only)
        return Stream(endpoint, layout, *frames, self._reconnect_timeout_s, self._record_emission)

    def fingers(self) -> Fingers:
        """Open a connection for the places of fingertips, for which frames that stand are refreshed first."""
        return Fingers(self._client.endpoint)

    def _record_emission(self) -> None:
        self._client.require_open()
        self._operations.may_emit = True

    def __repr__(self) -> str:
        return f"<Display at {self._client.endpoint.url}>"

    def _repr_png_(self) -> bytes | None:
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
