"""`optodrive status | arm | disarm | stop`, against a running daemon."""

from typing import Any

import typer

from optodrive.cli.options import DEFAULT_URL, JsonOption, UrlOption, print_json


def register(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (status, arm, disarm, stop):
        app.command()(command)


def status(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Show the board, the link and the queue."""
    _print_state(_call(url, "GET", "/v1/state"), json)


def arm(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Arm the board; its indicator is lit for two seconds first."""
    _print_state(_call(url, "POST", "/v1/arm"), json)


def disarm(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Disarm the board; also acknowledges a fault whose cause is gone."""
    _print_state(_call(url, "POST", "/v1/disarm"), json)


def stop(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """Gate off now; everything queued is dropped, the board disarmed."""
    _print_state(_call(url, "POST", "/v1/stop"), json)


def _call(url: str, method: str, path: str) -> dict[str, Any]:
    from optodrive.client.http import DaemonClient

    return DaemonClient(url).call(method, path)


def _print_state(state: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(state)
        return
    board = state["board"]
    print(f"display   {state['display']}, {state['pixels']} pixels")
    print(f"link      {state['link']['port']}: {state['link']['state']}")
    print(f"board     {board['state']}" + (f", fault {board['fault']}: {board['hint']}" if board["fault"] else ""))
    print(f"queue     {state['queue']['waiting']} waiting, running {state['queue']['running'] or 'nothing'}")
    print(f"executed  {state['totals']['executed']} pulses of {state['totals']['sent']} sent")
    if state["link"]["likely_cause"]:
        print(f"cause     {state['link']['likely_cause_ago_s']:.0f} s ago: {state['link']['likely_cause']}")
    if state["link"]["error"]:
        print(f"error     {state['link']['error']}")
