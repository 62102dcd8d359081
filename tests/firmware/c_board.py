"""The bench of the simulated board with a C core."""

from board_bench import Bench

from c_core import CBoard
from optodrive.link.protocol import messages as m
from optodrive.link.simulator.board_limits import DEFAULT_LIMITS, BoardSettings


class CBench(Bench):
    """The bench of the simulated board with a C core."""

    def __init__(self, library, limits=None, **settings):
        super().__init__(limits, **settings)
        self.log.clear()
        own = m.Limits(**{**vars(DEFAULT_LIMITS), **(limits or {})})
        self.core = CBoard(library, BoardSettings(limits=own, **settings), self.log.append)

    @property
    def limits(self):
        return self.core.limits

    def condition(self):
        return self.core.fingerprint

    def bad_frames(self):
        return self.core.bad_frames
