"""`optodrive status | arm | disarm | stop`: control a running daemon."""

from typing import TYPE_CHECKING

import typer

from optodrive.cli.options import DEFAULT_URL, JsonOption, UrlOption
from optodrive.cli.output import print_json

if TYPE_CHECKING:
    from optodrive.daemon.responses.state import StateReport


def register(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (status, arm, disarm, stop):
        app.command()(command)


def status(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Show the board, the link and the queue."""
    from optodrive.client.http import DaemonClient
    from optodrive.client.requests import READ_STATE

    _print_state(DaemonClient(url).call(READ_STATE), json)


def arm(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Arm the board; its indicator is on for two seconds first."""
    from optodrive.client.http import DaemonClient
    from optodrive.client.requests import ARM

    _print_state(DaemonClient(url).call(ARM), json)


def disarm(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Disarm the board; this also acknowledges a fault whose cause is gone."""
    from optodrive.client.http import DaemonClient
    from optodrive.client.requests import DISARM

    _print_state(DaemonClient(url).call(DISARM), json)


def stop(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Switch the gate off, drop everything queued, disarm the board."""
    from optodrive.client.http import DaemonClient
    from optodrive.client.requests import STOP

    _print_state(DaemonClient(url).call(STOP), json)


def _print_state(state: "StateReport", as_json: bool) -> None:
    if as_json:
        print_json(state)
        return
    board, link, queue, totals = state.board, state.link, state.queue, state.totals
    print(f"display   {state.display}, {state.pixels} pixels")
    print(f"link      {link.port}: {link.state}")
    print(f"board     {board.state}" + (f", fault {board.fault}: {board.hint}" if board.fault else ""))
    print(f"queue     {queue.waiting} waiting, running {queue.running or 'nothing'}")
    print(f"executed  {totals.executed} pulses of {totals.sent} sent")
    if link.likely_cause:
        print(f"cause     {link.likely_cause_age_s:.0f} s ago: {link.likely_cause}")
    if link.error:
        print(f"error     {link.error}")
