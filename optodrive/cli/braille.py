"""`optodrive braille`: the display as a braille display that screen readers drive unmodified."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import HoldOption, UrlOption
from optodrive.core.daemon_url import DEFAULT_URL

HEIGHT_UM = 150.0
KEY_FILE = Path("/etc/brlapi.key")


class ReaderProtocol(StrEnum):
    """Protocols of screen readers."""

    HUMANWARE = "humanware"
    BRLAPI = "brlapi"


def braille(
    port: Annotated[
        str, typer.Argument(metavar="PORT", help="Name of the serial port to create; with brlapi the server's number.")
    ],
    protocol: Annotated[
        ReaderProtocol,
        typer.Option("--protocol", help="humanware: one line, brltty -b hw; brlapi: several lines, brltty -b ba."),
    ] = ReaderProtocol.HUMANWARE,
    key_file: Annotated[
        Path, typer.Option("--key-file", help="With brlapi: key that a client must be able to read.")
    ] = KEY_FILE,
    height_um: Annotated[float, typer.Option("--height-um", min=0.0, help="Height of a dot, µm.")] = HEIGHT_UM,
    url: UrlOption = DEFAULT_URL,
    hold: HoldOption = False,
) -> None:
    """Be a braille display for an unmodified screen reader. Keys by name on stdin."""
    from optodrive.cli.signals import end_as_interrupted
    from optodrive.client.brlapi import CellPage
    from optodrive.client.display import Display
    from optodrive.client.humanware import CellLine
    from optodrive.client.reader_channels import (
        HOST,
        ReaderChannel,
        SerialChannel,
        SocketChannel,
        parse_number,
        read_key,
    )
    from optodrive.client.reader_port import CellProtocol, ReaderPort, cut_rectangle, find_cell_lines, join_lines
    from optodrive.link.simulator.pseudo_terminal import check_link_path

    is_server = protocol is ReaderProtocol.BRLAPI
    if is_server:
        number, key = parse_number(port), read_key(key_file)
    else:
        check_link_path("PORT", Path(port))
    with end_as_interrupted(), Display(url) as display:
        layout = display.layout
        places = find_cell_lines(layout, display.state().display)
        if hold:
            display.arm(hold=True)
        cells: CellProtocol
        channel: ReaderChannel
        if is_server:
            places = cut_rectangle(places, layout)
            page = CellPage(len(places), len(places[0]), key)
            cells, channel = page, SocketChannel(number, page)
            opened = f"{page.rows} lines of {page.columns} cells at {HOST}:{number}"
        else:
            places = [join_lines(places)]
            cells, channel = CellLine(len(places[0])), SerialChannel(Path(port))
            opened = f"{cells.count} cells at {port}"
        pixels = [slot for line in places for slot in line]
        try:
            with display.stream() as stream:
                print(f"{opened}; Ctrl-C ends it", flush=True)
                ReaderPort(channel, cells, stream, pixels, height_um, len(layout), _report).run()
        finally:
            channel.close()


def _report(text: str) -> None:
    print(f"optodrive: {text}", file=sys.stderr, flush=True)
