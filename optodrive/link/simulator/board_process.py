"""The simulated board as a process on a pseudo-terminal.

python -m optodrive.link.simulator.board_process --pty LINK [--log FILE] [--limits FILE] [--script FILE] [--baud N]
    [--clock-ppm N] [--clock-wander-ppm N]
    [--sensor LINK [--geometry SEED] [--config FILE] [--sensor-noise-um N] [--outlier-share N] [--no-readback]
        [--truth MODEL]]
"""

import argparse
import signal
import sys
from functools import partial
from pathlib import Path
from typing import NoReturn

from optodrive.core.errors import InputError
from optodrive.core.processes import LIGHT, set_realtime_priority
from optodrive.link.simulator.board_core import BoardClock, BoardCore
from optodrive.link.simulator.guards import BoardSettings, load_settings
from optodrive.link.simulator.pseudo_terminal import check_link_path
from optodrive.link.simulator.pty_board import NO_ACTIONS, BackendFactory, PtyBoard, ScriptActions
from optodrive.link.simulator.script import load_script
from optodrive.link.simulator.sensor_options import add_sensor_options, build_optics

BAUD_MIN = 300
CLOCK_PPM_MAX = 200


class _Parser(argparse.ArgumentParser):
    """A parser whose refusal is one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


def _check_options(options: argparse.Namespace) -> None:
    check_link_path("--pty", options.pty)
    if options.baud < BAUD_MIN:
        raise InputError("--baud", options.baud, f"at least {BAUD_MIN}")
    for name in ("clock_ppm", "clock_wander_ppm"):
        if not abs(getattr(options, name)) <= CLOCK_PPM_MAX:
            option = f"--{name.replace('_', '-')}"
            raise InputError(option, getattr(options, name), f"-{CLOCK_PPM_MAX} to {CLOCK_PPM_MAX}")


def main(
    arguments: list[str] | None = None, build_core: BackendFactory = BoardCore, actions: ScriptActions = NO_ACTIONS
) -> int:
    """Run a board until SIGTERM or SIGINT, and return the exit status."""
    parser = _Parser(prog="optodrive.link.simulator.board_process", description="Simulated board on a pty.")
    parser.add_argument("--pty", type=Path, required=True, metavar="LINK", help="link to create to the pty")
    parser.add_argument("--log", type=Path, help="JSON lines of gate edges, states, faults and pulses")
    parser.add_argument("--limits", type=Path, help="TOML file of the board's own limits")
    parser.add_argument("--script", type=Path, help="TOML file of timed steps")
    parser.add_argument("--baud", type=int, default=1_000_000, help="rate of the serial line")
    parser.add_argument(
        "--exit-when-closed",
        type=float,
        metavar="SECONDS",
        help="exit when no host has had the port open for this time",
    )
    parser.add_argument("--clock-ppm", type=float, default=0.0, metavar="N", help="error of the board's oscillator")
    parser.add_argument(
        "--clock-wander-ppm", type=float, default=0.0, metavar="N", help="its amplitude over ten minutes"
    )
    parser.add_argument("--seed", type=int, help="seed of the nonces, for a session that can be replayed")
    add_sensor_options(parser)
    options = parser.parse_args(arguments)
    try:
        _check_options(options)
        settings = load_settings(options.limits) if options.limits else BoardSettings()
        script = load_script(options.script, actions) if options.script else []
        log = options.log.open("ab", buffering=0) if options.log else None
        optics = build_optics(options, settings)
    except InputError as error:
        print(f"optodrive.link.simulator.board_process: {error}", file=sys.stderr)
        return error.exit_status
    except OSError as error:
        print(f"optodrive.link.simulator.board_process: --log {options.log}: {error.strerror}", file=sys.stderr)
        return 2
    clock = BoardClock(1e-6 * options.clock_ppm, 1e-6 * options.clock_wander_ppm)
    simulated = build_core is BoardCore
    if simulated:
        galvos = optics.galvos if optics else None
        build_core = partial(
            BoardCore,
            seed=options.seed,
            mirror_sink=galvos.move_to if galvos else None,
            mirror_source=galvos.measure if galvos else None,
        )
    board = PtyBoard(
        options.pty, log, settings, script, options.baud, options.exit_when_closed, build_core, actions, optics, clock
    )
    if simulated:
        set_realtime_priority(LIGHT)  # not for an emulator, which this process would starve
    signal.signal(signal.SIGTERM, board.stop)
    signal.signal(signal.SIGINT, board.stop)
    signal.signal(signal.SIGUSR1, board.on_signal)
    board.run()
    if board.failure:
        print(f"optodrive.link.simulator.board_process: {board.failure}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
