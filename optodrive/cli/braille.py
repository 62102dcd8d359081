"""`optodrive braille`: the display as a braille display that screen readers drive unmodified."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import HoldOption, UrlOption
from optodrive.core.daemon_url import DEFAULT_URL

HEIGHT_UM = 150.0


def braille(
    port: Annotated[Path, typer.Argument(metavar="PORT", help="Name of the serial port to create.")],
    height_um: Annotated[float, typer.Option("--height-um", min=0.0, help="Height of a dot, µm.")] = HEIGHT_UM,
    url: UrlOption = DEFAULT_URL,
    hold: HoldOption = False,
) -> None:
    """Be a braille display for a screen reader (brltty -b hw -d serial:PORT). Keys by name on stdin."""
    from optodrive.cli.signals import end_as_interrupted
    from optodrive.client.display import Display
    from optodrive.client.humanware import CellLine
    from optodrive.client.reader_port import ReaderPort, find_cell_pixels
    from optodrive.link.simulator.pseudo_terminal import check_link_path, open_pty, remove_link

    check_link_path("PORT", port)
    with end_as_interrupted(), Display(url) as display:
        layout = display.layout
        pixels = find_cell_pixels(layout, display.state().display)
        if hold:
            display.arm(hold=True)
        line = CellLine(len(pixels))
        terminal = open_pty(port)
        name = port.readlink()
        try:
            with display.stream() as stream:
                print(f"{line.count} cells at {port}; Ctrl-C ends it", flush=True)
                ReaderPort(terminal, line, stream, pixels, height_um, len(layout), _report).run()
        finally:
            remove_link(port, name)


def _report(text: str) -> None:
    print(f"optodrive: {text}", file=sys.stderr, flush=True)
