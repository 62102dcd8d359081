"""The board of a laser DAC as a process on a pseudo-terminal.

python -m optodrive.link.simulator.dac_process --pty LINK --settings FILE.json
"""

import argparse
import json
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import InputError, LinkError
from optodrive.core.laser_power import Curve
from optodrive.core.processes import LIGHT, set_realtime_priority
from optodrive.device.config_sections import BoardSection
from optodrive.link.dac.laser_dac import LaserDac
from optodrive.link.dac.registry import build_dac
from optodrive.link.simulator.board_machine import LogSink
from optodrive.link.simulator.dac_board import DacBoard, build_levels
from optodrive.link.simulator.guards import BoardSettings, build_settings
from optodrive.link.simulator.pty_board import PtyBoard
from optodrive.planning.heat_record import UNKNOWN_UID

LINGER_S = 1.0
"""Time after which the process ends when no host has its port open."""


def run_board(dac: LaserDac, link: Path, own_settings: dict[str, Any], curve: Curve) -> None:
    """Run the board of an open DAC until SIGTERM or SIGINT, or until its host has left."""

    def build_core(settings: BoardSettings, sink: LogSink) -> DacBoard:
        return DacBoard(settings, dac, build_levels(dac.format, curve), sink)

    settings = replace(build_settings(own_settings), uid=dac.find_uid() or UNKNOWN_UID)
    board = PtyBoard(link, None, settings, [], dac.board.baud, LINGER_S, build_core)
    set_realtime_priority(LIGHT)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, board.stop)
    board.run()


def main(arguments: list[str] | None = None) -> int:
    """Run a board and return the exit status. A failure is one line on stderr."""
    parser = argparse.ArgumentParser(prog="optodrive.link.simulator.dac_process", description="Board of a laser DAC.")
    parser.add_argument("--pty", type=Path, required=True, metavar="LINK", help="link to create to the pty")
    parser.add_argument("--settings", type=Path, required=True, help="address and limits as JSON")
    options = parser.parse_args(arguments)
    try:
        port = json.loads(options.settings.read_text())
        own_settings, curve = port.pop("own_settings"), port.pop("curve")
        dac = build_dac(BoardSection(**port), MonotonicClock())
        dac.require_interlock()
        with dac:
            run_board(dac, options.pty, own_settings, curve)
    except (InputError, LinkError) as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
