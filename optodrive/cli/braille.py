"""`optodrive braille`: the display as a braille display that screen readers drive unmodified."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import HoldOption, UrlOption
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.errors import MISSING, InputError

HEIGHT_UM = 150.0
KEY_FILE = Path("/etc/brlapi.key")


class ReaderProtocol(StrEnum):
    """Protocols of screen readers."""

    HUMANWARE = "humanware"
    DOTPAD = "dotpad"
    DOTPAD_GRAPHIC = "dotpad-graphic"
    BRLAPI = "brlapi"


def braille(
    port: Annotated[
        str, typer.Argument(metavar="PORT", help="Name of the serial port to create; with brlapi the server's number.")
    ],
    protocol: Annotated[
        ReaderProtocol,
        typer.Option(
            "--protocol",
            help="humanware, brltty -b hw: one line. brlapi, -b ba, and dotpad, -b dp: several. "
            "dotpad-graphic, -b dp: a line above dots.",
        ),
    ] = ReaderProtocol.HUMANWARE,
    key_file: Annotated[
        Path, typer.Option("--key-file", help="With brlapi: key that a client must be able to read.")
    ] = KEY_FILE,
    height_um: Annotated[
        float, typer.Option("--height-um", min=1.0, max=1000.0, help="Height of a dot, µm.")
    ] = HEIGHT_UM,
    fingers: Annotated[
        bool, typer.Option("--fingers", help="Refresh dots under fingers first, whose places a tracker reports.")
    ] = False,
    touched_only: Annotated[
        bool, typer.Option("--touched-only", help="With --fingers: leave dots dark that no finger touches.")
    ] = False,
    url: UrlOption = DEFAULT_URL,
    hold: HoldOption = False,
) -> None:
    """Be a braille display for an unmodified screen reader. Keys by name on stdin."""
    from optodrive.cli.signals import end_as_interrupted
    from optodrive.client.brlapi import CellPage
    from optodrive.client.cell_places import (
        compute_pitch_m,
        cut_rectangle,
        divide_display,
        find_cell_lines,
        join_lines,
        plan_area,
    )
    from optodrive.client.display import Display
    from optodrive.client.dotpad import CellGrid
    from optodrive.client.humanware import CellLine
    from optodrive.client.reader_port import (
        HOST,
        CellProtocol,
        ReaderChannel,
        ReaderPort,
        SerialChannel,
        SocketChannel,
        parse_number,
        read_key,
    )
    from optodrive.link.simulator.pseudo_terminal import check_link_path

    if touched_only and not fingers:
        raise InputError("--fingers", MISSING, "--fingers with --touched-only")
    is_server = protocol is ReaderProtocol.BRLAPI
    if is_server:
        number, key = parse_number(port), read_key(key_file)
    else:
        check_link_path("PORT", Path(port))
    with end_as_interrupted(), Display(url) as display:
        layout, name = display.layout, display.state().display
        if protocol is ReaderProtocol.DOTPAD_GRAPHIC:
            text, graphic = divide_display(layout, name)
        else:
            lines = find_cell_lines(layout, name)
            is_line = protocol is ReaderProtocol.HUMANWARE
            text, graphic = [join_lines(lines)] if is_line else cut_rectangle(lines, layout), []
        if hold:
            display.arm(hold=True)
        cells: CellProtocol
        channel: ReaderChannel
        if is_server:
            page = CellPage(len(text), len(text[0]), key)
            cells, channel, place = page, SocketChannel(number, page), f"{HOST}:{number}"
        else:
            if protocol is ReaderProtocol.HUMANWARE:
                cells = CellLine(len(text[0]))
            else:
                text_area, graphic_area = (plan_area(display, lines, height_um) for lines in (text, graphic))
                cells = CellGrid(text_area, graphic_area, compute_pitch_m(layout, text[0][0]))
            channel, place = SerialChannel(Path(port)), port
        size = f"{len(text[0])} cells" if len(text) == 1 else f"{len(text)} lines of {len(text[0])} cells"
        if graphic:
            size += f", {4 * len(graphic)} rows of {2 * len(graphic[0])} dots"
        pixels = [slot for line in text + graphic for slot in line]
        try:
            with display.stream(standing=fingers, touched_only=touched_only) as stream:
                print(f"{size} at {place}; Ctrl-C ends it", flush=True)
                ReaderPort(channel, cells, stream, pixels, height_um, len(layout), _report, fingers).run()
        finally:
            channel.close()


def _report(text: str) -> None:
    print(f"optodrive: {text}", file=sys.stderr, flush=True)
