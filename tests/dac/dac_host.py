"""A host of a laser DAC's board in virtual time: real session, protocol, board and driver, emulated device."""

from dataclasses import replace

import numpy as np

from dac.bench import build_config, build_network_display
from dac.emulated_ether_dream import VirtualStream
from dac.emulated_helios import CLOCK_HZ as HELIOS_HZ
from dac.emulated_helios import EmulatedHelios
from dac.emulated_idn import VirtualRadio
from dac.judge import read_light
from optodrive.core.clock import ManualClock
from optodrive.link.board_setup import build_board_settings, build_scales
from optodrive.link.dac.devices.ether_dream import EtherDream
from optodrive.link.dac.devices.helios import Helios
from optodrive.link.dac.devices.idn import Idn
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.dac_board import DacBoard, build_levels
from optodrive.link.simulator.guards import build_settings
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.planning.pipeline import plan_sequence

TRANSPORTS = ("ether_dream", "helios", "idn")
STEP_S = 0.001
START_LEAD_S = 0.05


class DacHost:
    """One display on a laser DAC. Time passes only while it is called.

    board: class of the board; device: options of the emulated device
    """

    def __init__(self, transport, board=DacBoard, **device):
        self.transport, self.clock = transport, ManualClock(1.0)
        self.display = build_network_display(transport)
        section = build_config(transport=transport, port="dac").board
        if transport == "ether_dream":
            self.device = VirtualStream(self.clock, **device)
            self.dac = EtherDream(section, self.clock, self.device.connect, lambda host, clock: "00:04:a3:01:02:03")
        elif transport == "idn":
            self.device = VirtualRadio(self.clock, **device)
            self.dac = Idn(section, self.clock, self.device.connect)
        else:
            self.device = EmulatedHelios(self.clock, **device)
            self.dac = Helios(section, self.clock, self.device)
        self.dac.open()
        (settings,) = build_board_settings(self.display.config)
        self.scales = build_scales(self.display.config)
        self.board = board(build_settings(settings.port.own_settings), self.dac, build_levels(self.dac.format), seed=1)
        session = BoardSession(MemoryLink(self.board, self.clock), self.clock, settings.requirements, False)
        self.boards = BoardGroup([session], self.clock, [lambda: True], [""])
        while not self.boards.connected:
            self.boards.step_connecting()

    def step(self, duration_s=STEP_S, renew_lease=True):
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s - 1e-9:
            self.boards.step(STEP_S, renew_lease=renew_lease)

    def arm(self):
        self.boards.arm()
        while self.boards.state != "ARMED":
            self.boards.step(5 * STEP_S, renew_lease=True)

    def plan(self, sequence, budget=None):
        heat, cold = self.display.build_cold_state()
        return plan_sequence(self.display, sequence, heat, cold if budget is None else budget).plan

    def begin(self, plan):
        points = StagePoints.from_plan(plan, self.scales)
        return self.boards.begin(points, self.boards.board_s() + START_LEAD_S)

    def play(self, plan):
        job = self.begin(plan)
        while not job.is_finished:
            self.step()
        self.step(0.2)
        return job.build_executed(plan, self.scales)

    def pass_time(self, duration_s):
        """Let time pass without the host."""
        self.device.pass_time(duration_s)

    def table(self):
        """Return what the device put out so far."""
        self.pass_time(0.0)
        if self.transport == "helios":
            device = self.device.device
            ends_s = [*(output.at_s for output in device.log[1:]), device.now / HELIOS_HZ]
            return np.array(
                [
                    (output.at_s, end_s, number, output.x, output.y, max(output.colour) / 255)
                    for number, (output, end_s) in enumerate(zip(device.log, ends_s, strict=True))
                ]
            )
        return self.device.core.log.table(self.device.core.now_s)

    def light(self, since_s=0.0):
        """Return the light since a time of the device."""
        light = read_light(self.table(), self.display, 1.0)
        kept = light.start_s >= since_s
        columns = {name: value[kept] for name, value in vars(light).items() if name not in ("moves_s", "moves_rad")}
        return replace(light, **columns)
