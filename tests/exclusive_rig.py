"""Exclusive access to a simulated board in virtual time, with its log."""

from optodrive.core.clock import ManualClock
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.link.board_setup import build_port_settings
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.guards import build_settings
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.planning.display_model import DisplayModel


class ExclusiveRig:
    """A board in the same process, and exclusive access to it.

    mirror_sink: receives each move of the mirrors
    """

    def __init__(self, display, mirror_sink):
        self.log, self.clock = [], ManualClock(3.0)
        own = build_settings(build_port_settings(display.config).own_settings)
        self.core = BoardCore(own, self.log.append, seed=4, mirror_sink=mirror_sink)
        self.held = ExclusiveBoard(display, MemoryLink(self.core, self.clock), self.clock)

    def of(self, kind):
        """Return the events of a kind."""
        return [event for event in self.log if event["event"] == kind]

    def armed(self):
        """Connect and arm."""
        self.held.connect()
        self.held.arm()
        return self.held


def limited(display, **caps):
    """Return the display with other caps."""
    limits = display.config.limits.model_copy(update=caps)
    return DisplayModel.from_config(display.config.model_copy(update={"limits": limits}))
