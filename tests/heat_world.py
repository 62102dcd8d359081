"""A computer and a board with a uid of its own, in virtual time: daemons and commands on it, one after another."""

import os
import shutil
import tempfile
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from displays import DISPLAYS
from link_service_rig import SUPERVISOR, WEB
from optodrive.core.clock import ManualClock
from optodrive.core.errors import OptodriveError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.link.board_setup import build_port_settings, build_scales
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.guards import build_settings
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.planning import heat_record
from optodrive.planning.pipeline import plan_sequence
from planner_rig import PlannerRig
from reference_models.shipped_display import build_model, build_worst_factors
from reference_models.thermal_display import TOUCHED, build_true_display

DISPLAY = DISPLAYS["display-16"]
UIDS = ("0a" * 12, "0b" * 12)
TRUE_DISPLAY = build_true_display(build_model("display-16"), build_worst_factors("display-16", -1))
MUCH_LIGHT = FrameSequence(trains=(PulseTrain(5, 0.0, 4.0, 0.04, 0.002, 2.45),))
SHORT = FrameSequence(trains=(PulseTrain(5, 0.0, 1.0, 0.04, 0.01, 1.5),))
BENCH_PLAN = plan_sequence(DISPLAY, SHORT, *DISPLAY.build_cold_state()).plan
PATIENCE_S = 2.0
"""A person at a command gives up when the display must cool for longer."""
UNPOWERED_S = 20.0
NOBODY = 65534


class GivenUpError(Exception):
    """A command was interrupted."""


class ServeRig(PlannerRig):
    """A daemon on the world's board, on the world's clock."""

    def __init__(self, monkeypatch, world):
        self._world = world
        super().__init__(monkeypatch, display=DISPLAY)

    def build_boards(self, link_type, settings, requirements):
        self.clock, self.core, self.log = self._world.clock, self._world.core, self._world.log
        self.link = link_type(self.core, self.clock)
        self.session = BoardSession(self.link, self.clock, requirements)
        return BoardGroup([self.session], self.clock, [self.open_port])

    def pass_time(self, duration_s):
        """Let daemon and board run."""
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            self.run()


class World:
    """A computer and a board, and what runs on both."""

    def __init__(self, monkeypatch):
        self.monkeypatch = monkeypatch
        self.folder = Path(tempfile.mkdtemp(prefix="heat"))
        self.folder.chmod(0o755)
        self.clock, self.log, self.boot, self.booted_s, self.backup = ManualClock(1000.0), [], 1, 0.0, None
        self.use_board(UIDS[0])
        monkeypatch.setattr(heat_record, "FOLDER", self.folder / "heat")
        monkeypatch.setattr(heat_record, "read_boot", lambda: (f"run {self.boot}", self.clock.now_s() - self.booted_s))

    def use_board(self, uid):
        """Let another board draw the display, whose record may be that of another display."""
        own = build_settings(build_port_settings(DISPLAY.config).own_settings)
        self.core = BoardCore(replace(own, uid=uid), self.log.append, seed=4)

    def record_cold(self, uid=UIDS[0]):
        """Let a board have the record of a display that has been dark for long."""
        with heat_record.HeatRecord(heat_record.BOARDS, uid, DISPLAY, self.clock) as record:
            record.save(DISPLAY.build_cold_state()[1])

    @contextmanager
    def as_user(self, user):
        if user in (None, os.geteuid()):
            yield
            return
        os.seteuid(user)
        try:
            yield
        finally:
            os.seteuid(0)

    def run(self, program, ends="stopped", after_s=1.0, user=None):
        """Run a daemon or a command of a user. ends: stopped, or killed or interrupted, after_s from its first plan."""
        with self.as_user(user):
            getattr(self, program)(ends, after_s)
        self.pass_time(0.5)

    def pass_time(self, duration_s):
        """Let the board go on, with nobody to renew its lease."""
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            self.clock.sleep(0.01)
            self.core.advance(round(self.clock.now_s() * 1e6))

    def serve(self, ends, after_s):
        rig = ServeRig(self.monkeypatch, self).ready()
        with suppress(OptodriveError):
            rig.await_result(WEB, rig.request(WEB, "disarm"))  # which acknowledges a fault
            rig.arm()
            rig.pass_time(0.02)
            rig.submit(MUCH_LIGHT, rig.remote.epoch).result()
            rig.pass_time(after_s if ends != "stopped" else 4.2)
        if ends == "killed":
            release(rig.heat._record)
            return
        if ends == "stopped":
            rig.await_result(SUPERVISOR, rig.request(SUPERVISOR, "stop"))
            rig.pass_time(0.01)
        rig.remote.connection.close()  # else it ends first, and the link process sees that
        rig.heat.close()
        rig.service.close()

    def bench(self, ends, after_s):
        held = ExclusiveBoard(DISPLAY, MemoryLink(self.core, self.clock), self.clock)
        began_s, wait = self.clock.now_s(), held.wait

        def wait_patiently(duration_s):
            if duration_s > PATIENCE_S:
                raise GivenUpError
            wait(duration_s)

        def look(_job):
            if ends != "stopped" and self.clock.now_s() > began_s + after_s:
                raise GivenUpError

        held.wait = wait_patiently
        with suppress(OptodriveError, GivenUpError):
            held.connect()
            held.disarm()
            held.arm()
            began_s = self.clock.now_s()
            for _ in range(3):
                held.play(BENCH_PLAN, look)
        if ends == "killed":
            release(held._record)
        else:
            held.close()

    def do(self, fault):
        """Do something to the record, the board or the computer."""
        path = self.folder / "heat" / f"board-{UIDS[0]}"
        if fault == "restart":
            self.pass_time(UNPOWERED_S)
            self.boot, self.booted_s = self.boot + 1, self.clock.now_s()
        elif fault == "lose all":
            shutil.rmtree(self.folder / "heat", ignore_errors=True)
        elif fault == "back up" and path.exists():
            self.backup = path.read_bytes()
        elif path.exists():
            if fault == "lose":
                path.unlink()
            elif fault == "cut":
                path.write_bytes(path.read_bytes()[:-100])
            elif fault == "restore" and self.backup is not None:
                mtime_ns = path.stat().st_mtime_ns
                path.write_bytes(self.backup)
                os.utime(path, ns=(mtime_ns, mtime_ns))

    def count_light_j(self):
        """Return the energy of all light, J."""
        light = self.read_light()
        return float(light.power_w @ light.width_s)

    def read_light(self):
        layout, scale = DISPLAY.layout, build_scales(DISPLAY.config)[0]
        angle = 1.0 / (2.0 * DISPLAY.config.scanner.focal_length_m)
        codes = np.column_stack([scale.to_codes(at_m * angle) for at_m in (layout.x_m, layout.y_m)])
        events = [event for event in self.log if event["event"] == "pulse"]
        places = np.array([[event["x"], event["y"]] for event in events]).reshape(-1, 2)
        column = {
            name: np.array([event[name] for event in events], dtype=float) for name in ("on_us", "off_us", "duty")
        }
        return SimpleNamespace(
            start_s=column["on_us"] * 1e-6 - 1000.0,
            width_s=(column["off_us"] - column["on_us"]) * 1e-6,
            power_w=column["duty"] * scale.full_power_w / 65535,
            pixel=np.array([int(np.argmin(np.abs(codes - place).sum(axis=1))) for place in places], dtype=np.int64),
        )

    def judge(self):
        """Return by how much the hottest touched surface of the worst display has passed its cap, K."""
        return float(TRUE_DISPLAY.peaks(self.read_light())[list(TOUCHED)].max() - DISPLAY.budget.caps.touch_k)


def release(record):
    """Let go of a record as the kernel does when its process is killed."""
    if record is not None:
        record._exit_stack.close()


@contextmanager
def new_world():
    with pytest.MonkeyPatch.context() as patch:
        world = World(patch)
        try:
            yield world
        finally:
            shutil.rmtree(world.folder)
