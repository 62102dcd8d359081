"""`optodrive status | arm | disarm | dim | pause | resume | reload | stop`: control a running daemon.

They print what the daemon says, without its models, whose import takes longer than everything else that they do.
"""

import sys
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from optodrive.cli.invocation import Invocation
from optodrive.cli.options import HoldOption, JsonOption, StageOption, UrlOption
from optodrive.cli.output import print_json
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.core.quantity import format_quantity

if TYPE_CHECKING:
    from optodrive.daemon.responses.state import BoardReport, StageReport, StateReport


STATE_TIMEOUT_S = 2.0
"""Longest wait for the daemon's state after a STOP that the link process has confirmed."""


def status(url: UrlOption = DEFAULT_URL, stage: StageOption = None, json: JsonOption = False) -> None:
    """Show the boards, the link with its error counters, the queue, and the limits in effect."""
    from optodrive.client.api_request import READ_CONFIG, READ_STATE
    from optodrive.client.http import DaemonClient

    client = DaemonClient(url)
    state = client.call(READ_STATE)
    if stage is not None:
        _print_stage(state, stage, json)
        return
    _print_state(state, json)
    if not json:
        print(f"limits    {_format_limits(_view_object(client.call(READ_CONFIG)).limits)}")


def _print_stage(document: dict[str, Any], name: str, as_json: bool) -> None:
    """Print one of several stages. Raise InputError if the daemon drives none of this name."""
    stages = {stage["name"]: stage for stage in document["stages"]}
    if name not in stages:
        raise InputError("--stage", name, f"one of {', '.join(stages)}" if stages else "none: the daemon drives one")
    if as_json:
        print_json(stages[name])
    else:
        print(_format_stage(_view_object(stages[name])))


def arm(url: UrlOption = DEFAULT_URL, hold: HoldOption = False, json: JsonOption = False) -> None:
    """Arm the board. Its indicator is on for two seconds first. With --hold, until this command ends (Ctrl-C)."""
    from optodrive.client.api_request import ARM, READ_STATE
    from optodrive.client.http import DaemonClient

    client = DaemonClient(url)
    if not hold:
        _print_state(client.call(ARM), json)
        return
    from optodrive.client.hold import Hold

    with Hold(client.endpoint) as held:
        _print_state(client.call(READ_STATE), json)
        sys.stdout.flush()
        raise NotReadyError(f"the board was disarmed: {held.wait()}")


def _send(request: str, url: str, as_json: bool) -> None:
    """Send a request of `client.api_request`, and print the state that it answers."""
    from optodrive.client import api_request
    from optodrive.client.http import DaemonClient

    _print_state(DaemonClient(url).call(getattr(api_request, request)), as_json)


def disarm(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Disarm the board. This also acknowledges a fault whose cause is gone."""
    _send("DISARM", url, json)


def dim(
    share: Annotated[float, typer.Argument(metavar="SHARE", help="Share of the laser's power, 0 to 1.")],
    url: UrlOption = DEFAULT_URL,
    json: JsonOption = False,
) -> None:
    """Cap the power of every pulse of the plans from now on. Only an armer may raise it again."""
    from optodrive.client.api_request import build_dim_request
    from optodrive.client.http import DaemonClient

    request = build_dim_request(share)
    _print_state(DaemonClient(url).call(request), json)


def pause(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Switch the gate off. The board stays armed and plans wait, for five minutes at most."""
    _send("PAUSE", url, json)


def resume(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Play the rest of the paused plan, and the waiting plans."""
    _send("RESUME", url, json)


def reload(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Let the daemon read its configuration and tokens again. Some keys apply at once, the others after a restart."""
    from optodrive.client.api_request import RELOAD
    from optodrive.client.http import DaemonClient

    report = DaemonClient(url).call(RELOAD)
    if json:
        print_json(report)
    else:
        print(report["message"])


def stop(context: typer.Context, url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Switch the gate off, drop everything queued, disarm the board.

    On the daemon's computer it works even if the daemon hangs.
    """
    from optodrive.cli.direct_stop import stop_directly

    invocation: Invocation = context.obj
    result = invocation.stopped or stop_directly(url)
    from optodrive.client.api_request import READ_STATE, STOP
    from optodrive.client.http import DaemonClient

    if result is None:
        _print_state(DaemonClient(url).call(STOP), json)
        return
    try:
        state = DaemonClient(url, timeout_s=STATE_TIMEOUT_S).call(READ_STATE)
    except OptodriveError as error:
        _print_stopped(result, error, json)
    else:
        _print_state(state, json)


def _print_stopped(result: dict[str, Any], error: OptodriveError, as_json: bool) -> None:
    """Print the result of the link process.

    error: why the daemon's state is not known
    """
    board = result["board"]
    if as_json:
        print_json({"board": board})
    else:
        print(f"board     {board['state']}" + (f", fault {board['fault']}: {board['hint']}" if board["fault"] else ""))
    print(f"optodrive: the board was stopped; the state of the daemon is not known: {error}", file=sys.stderr)


class _Members(SimpleNamespace):
    """The members of a JSON object as attributes."""

    def __getattr__(self, name: str) -> Any:  # only for a member that is missing
        raise LinkError(f"the daemon's answer has no {name!r}: is the daemon of another version?")


def _view_object(value: Any) -> Any:
    """Return a JSON object with its members as attributes, as its model has them."""
    if isinstance(value, list):
        return [_view_object(item) for item in value]
    if isinstance(value, dict):
        return _Members(**{name: _view_object(item) for name, item in value.items()})
    return value


def _format_limits(limits: Any) -> str:
    caps = vars(limits.caps).values()
    return "; ".join(f"{cap.label} {format_quantity(getattr(limits, cap.setting), cap.unit, 6)}" for cap in caps)


def _format_board(board: "BoardReport") -> str:
    return board.state + (f", fault {board.fault}: {board.hint}" if board.fault else "")


def _format_stage(stage: "StageReport") -> str:
    if stage.lost is not None:
        return f"{stage.name} at {stage.port}: lost, the others go on: {stage.lost}"
    if not stage.connected:
        return f"{stage.name} at {stage.port}: no link: {stage.error}"
    clock = "clock unknown"
    if stage.clock_error_us is not None and stage.clock_drift_ppm is not None:
        clock = f"clock known to {stage.clock_error_us:.0f} µs, drifts {stage.clock_drift_ppm:+.1f} ppm"
    return f"{stage.name} at {stage.port}: {_format_board(stage.board)}; {clock}"


def _print_state(document: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(document)
        return
    state = cast("StateReport", _view_object(document))
    board, link, queue, totals = state.board, state.link, state.queue, state.totals
    print(f"display   {state.display}, {state.pixels} pixels")
    print(f"link      {link.port}: {link.state}")
    print(f"board     {_format_board(board)}")
    for stage in state.stages:
        print(f"stage     {_format_stage(stage)}")
    if state.control is not None:
        held = ", held by its connection" if state.control.hold else ""
        print(f"control   armed by {state.control.caller} {state.control.armed_for_s:.0f} s ago{held}")
    if state.limits.power_share is not None and state.limits.power_share < 1.0:
        print(f"dim       pulses have at most {state.limits.power_share:g} of full power")
    limits = state.limits
    if limits.hot_for_s is not None:
        print(
            f"heat      counts as hot, because {limits.hot_reason}; plans get less light for {limits.hot_for_s:.0f} s"
        )
    if queue.pause_ends_in_s is not None:
        print(f"paused    dark until `optodrive resume`; disarms in {queue.pause_ends_in_s:.0f} s")
    print(f"queue     {queue.waiting} waiting, running {queue.running or 'nothing'}")
    print(f"executed  {totals.executed} pulses of {totals.sent} sent")
    if totals.frames_shown or totals.frames_superseded:
        print(f"frames    {totals.frames_shown} of streams shown, {totals.frames_superseded} superseded before")
    if link.state == "up":
        print(
            f"counters  {link.retransmitted} frames retransmitted, {link.naks} refused, "
            f"{link.host_bad_frames} damaged on arrival here, {link.board_bad_frames} at the board; "
            f"{link.underruns} underruns; longest stall {link.longest_stall_ms:.0f} ms"
        )
    if link.likely_cause:
        print(f"cause     {link.likely_cause_age_s:.0f} s ago: {link.likely_cause}")
    if link.error:
        print(f"error     {link.error}")
