"""The emulated Cortex-M3 as a board process with the usual options and log, for a host that runs in real time.

python firmware_protocol/ports/mps2-an385/board.py [--image FILE] --pty LINK [--log FILE] [--limits FILE] …

The chip's time follows this computer's, as far as the computer keeps up. When a host's bytes reach the chip therefore
depends on the computer, so no test judges the chip by that: tests grant its time themselves.
"""

import sys
from functools import partial
from pathlib import Path

from emulated_chip import EmulatedChip

from optodrive.link.simulator.board_process import main

IMAGE = Path(__file__).parent / "build" / "board.elf"

if __name__ == "__main__":
    arguments = sys.argv[1:]
    image = IMAGE
    if "--image" in arguments:
        at = arguments.index("--image")
        image = Path(arguments[at + 1])
        del arguments[at : at + 2]
    actions = {name: partial(EmulatedChip.inject_fault, name=name) for name in EmulatedChip.FAULTS}
    sys.exit(main(arguments, partial(EmulatedChip, image), actions))
