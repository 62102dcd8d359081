"""`optodrive osc`: a live source that sends OSC, such as TouchDesigner, Max or Unity, drives the display."""

import sys
from typing import Annotated

import typer

from optodrive.cli.options import HoldOption, UrlOption
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.types.push_options import Policy

LISTEN = "127.0.0.1:9000"


def osc(
    listen: Annotated[
        str, typer.Option("--listen", metavar="ADDRESS:PORT", help="UDP port to listen on; port 0: any free one.")
    ] = LISTEN,
    senders: Annotated[
        list[str] | None,
        typer.Option("--from", metavar="ADDRESS", help="Take packets of this address only; may be repeated."),
    ] = None,
    scale_um: Annotated[
        float, typer.Option("--scale-um", min=0.001, max=1000.0, help="Height of the value 1, µm.")
    ] = 1.0,
    standing: Annotated[
        bool, typer.Option("--standing", help="Let heights stand until they change, or no packet comes for 2 s.")
    ] = False,
    policy: Annotated[Policy, typer.Option("--policy", help="Treatment of pulses above a cap.")] = "trim",
    reply: Annotated[
        str | None,
        typer.Option("--reply", metavar="ADDRESS:PORT", help="Send /shown there each second: frames per second."),
    ] = None,
    url: UrlOption = DEFAULT_URL,
    hold: HoldOption = False,
) -> None:
    """Show the heights that OSC messages set: /pixel N UM, /pixel/N UM, /heights UM…, /clear, /stop."""
    from optodrive.cli.signals import end_as_interrupted
    from optodrive.client.display import Display
    from optodrive.client.osc import OscBridge, OscHeights, UdpPort, parse_place, parse_sender

    place = parse_place(listen, "--listen")
    reply_place = None if reply is None else parse_place(reply, "--reply")
    port = UdpPort(place, [parse_sender(each) for each in senders or []])
    try:
        with end_as_interrupted(), Display(url) as display:
            heights = OscHeights(len(display.layout), scale_um)
            if hold:
                display.arm(hold=True)
            with display.stream(policy=policy, standing=standing) as stream:
                print(
                    f"{len(display.layout)} pixels at {port.place.host}:{port.place.port}; Ctrl-C ends it", flush=True
                )
                OscBridge(port, stream, heights, display.stop, _report, standing, reply_place).run()
    finally:
        port.close()


def _report(text: str) -> None:
    print(f"optodrive: {text}", file=sys.stderr, flush=True)
