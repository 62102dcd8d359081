"""Planner and link service in virtual time with the simulated boards of several stages, whose clocks drift."""

from functools import partial

import numpy as np

from displays import DISPLAYS
from link_service_rig import CuttableLink
from optodrive.core.errors import LinkError
from optodrive.device.config_sections import StageSection
from optodrive.link.board_setup import build_board_settings
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardClock, BoardCore
from optodrive.planning.display_model import DisplayModel
from planner_rig import PlannerRig

CLOCKS = (
    BoardClock(50e-6, offset_s=100.0),
    BoardClock(-50e-6, 5e-6, 3.0),
    BoardClock(20e-6, 20e-6, 7000.0),
    BoardClock(-30e-6, 15e-6, 0.0),
)


class DriftingLink(CuttableLink):
    """Link to a board with a clock of its own."""

    def __init__(self, core, clock, board_clock, name):
        super().__init__(core, clock)
        self.name = name
        self.board_clock = board_clock

    def _now_us(self):
        return round(self.board_clock.read_s(self._clock.now_s()) * 1e6)


class BreakingLink(DriftingLink):
    """Link that may break."""

    is_broken = False

    def read(self, timeout_s):
        self._require_whole()
        return super().read(timeout_s)

    def write(self, data):
        self._require_whole()
        super().write(data)

    def open(self):
        self._require_whole()

    def _require_whole(self):
        if self.is_broken:
            raise LinkError(f"/dev/{self.name}: unplugged")


class BusyLink(DriftingLink):
    """Link over a computer that wakes its programs late: the board's bytes arrive after delay_s."""

    delay_s = 0.0

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self._late = []

    def read(self, timeout_s):
        data = super().read(timeout_s)
        if data:
            self._late.append((self._clock.now_s() + self.delay_s, data))
        due = [late for late in self._late if late[0] <= self._clock.now_s()]
        self._late = self._late[len(due) :]
        return b"".join(data for _, data in due)


def build_stages(name, count, **changes):
    """Build a display with equal stages. changes: of its [limits]."""
    config = DISPLAYS[name].config
    sections = {"laser": config.laser, "scanner": config.scanner, "board": config.board}
    stages = tuple(StageSection(name=f"s{k}", **sections) for k in range(count))
    limits = config.limits.model_copy(update=changes)
    return DisplayModel.from_config(config.model_copy(update={"stages": stages, "limits": limits}))


class StageRig(PlannerRig):
    """Boards of several stages.

    logs: events of each board
    links: its link
    cores: the board
    """

    def __init__(
        self, monkeypatch, display, clocks=CLOCKS, link_type=DriftingLink, on_stage_loss="all_dark", **options
    ):
        self.display, self.clocks, self.link_type, self.on_stage_loss = display, clocks, link_type, on_stage_loss
        super().__init__(monkeypatch, display=display, **options)

    def build_boards(self, _, settings, requirements):
        boards = build_board_settings(self.display.config)
        self.logs = [[] for _ in boards]
        self.cores = [self.build_core(k, settings, log.append) for k, log in enumerate(self.logs)]
        pairs = zip(self.cores, self.clocks, boards, strict=False)
        self.links = [self.link_type(core, self.clock, clock, board.stage) for core, clock, board in pairs]
        sessions = [
            BoardSession(link, self.clock, board.requirements, is_one_of_several=True)
            for link, board in zip(self.links, boards, strict=True)
        ]
        self.session = sessions[0]
        skew_max_s = self.display.config.limits.stage_skew_max_s
        openers = [partial(self.open_link, link) for link in self.links]
        names = [board.stage for board in boards]
        return BoardGroup(sessions, self.clock, openers, names, skew_max_s, self.on_stage_loss)

    def build_core(self, stage, settings, sink):
        return BoardCore(settings, sink=sink, seed=3 + stage)

    @staticmethod
    def open_link(link):
        link.open()
        return True

    def list_pulses(self):
        """Return the pulses of all boards by their own logs, in host time: begin, end, x and y code, stage, [n, 5]."""
        rows = []
        for stage, (log, clock) in enumerate(zip(self.logs, self.clocks, strict=False)):
            for event in log:
                if event["event"] == "pulse":
                    on_s, off_s = (clock.find_true_s(event[key] * 1e-6) for key in ("on_us", "off_us"))
                    rows.append((on_s, off_s, event["x"], event["y"], stage))
        return np.array(sorted(rows)).reshape(-1, 5)
