"""Simulated board whose indicator lasts 0.1 s before it emits, for tests of anything but the indicator.

With `--full-indicator` as its first argument, the indicator lasts as long as it must, with `--long-indicator` an hour.
The board writes the host's
monotonic time at the zero of its log's clock, s, next to the link to its port.
"""

import sys
from pathlib import Path

from optodrive.link.simulator import board_machine, board_process
from optodrive.link.simulator.pty_board import PtyBoard

INDICATOR_US = 100_000
LONG_INDICATOR_US = 3_600_000_000
FULL_INDICATOR, LONG_INDICATOR = "--full-indicator", "--long-indicator"


class ClockedBoard(PtyBoard):
    """Board that states its clock."""

    def __init__(self, link, *arguments):
        super().__init__(link, *arguments)
        Path(f"{link}.clock").write_text(f"{self._started_s!r}\n")


def main():
    if sys.argv[1:2] == [FULL_INDICATOR]:
        del sys.argv[1]
    elif sys.argv[1:2] == [LONG_INDICATOR]:
        del sys.argv[1]
        board_machine.INDICATOR_US = LONG_INDICATOR_US
    else:
        board_machine.INDICATOR_US = INDICATOR_US
    board_process.PtyBoard = ClockedBoard
    return board_process.main()


if __name__ == "__main__":
    sys.exit(main())
