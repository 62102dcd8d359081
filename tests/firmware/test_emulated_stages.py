"""Two boards of one display in one virtual time: the core in this process, and on an emulated Cortex-M3."""

import numpy as np
import pytest

from c_core import SeededCBoard
from displays import DISPLAYS
from link_service_rig import OPERATOR
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.link.simulator.board_core import BoardClock
from planner_rig import build_frame
from stage_rig import StageRig, build_stages

CLOCKS = BoardClock(50e-6), BoardClock(-50e-6, 10e-6, offset_s=-5.0)
"""The second one starts with the host, as each second costs the emulator time."""
LEASE_S = DISPLAYS["display-437"].config.board.lease_s
LATE_MAX_S = 1e-4
CORE, CHIP = 0, 1


class MixedRig(StageRig):
    """The core and the chip as the boards of two stages."""

    def __init__(self, monkeypatch, library, make_chip):
        self._library, self._make_chip = library, make_chip
        super().__init__(monkeypatch, build_stages("display-437", 2), clocks=CLOCKS)

    def build_core(self, stage, settings, sink):
        if stage == CORE:
            return SeededCBoard(self._library, settings, sink, seed=3)
        return self._make_chip(settings, sink, seed=4)

    def play(self, sequence):
        return self.store.find(self.submit(sequence, self.remote.epoch).result().plan)

    def play_trains(self):
        """Play trains on both stages until some pulses have been emitted. Return the plan's record."""
        trains = tuple(PulseTrain(pixel, 0.0, 5.0, 0.01, 0.01, 1.0) for pixel in (100, 300))
        before = self.count_pulses()
        record = self.play(FrameSequence((), trains))
        self.until(lambda: min(np.subtract(self.count_pulses(), before)) > 5)
        return record

    def count_pulses(self):
        return [sum(event["event"] == "pulse" for event in log) for log in self.logs]

    def last_s(self, stage, kind):
        """Return the time of a board's last log entry of a kind, in host time."""
        return self.clocks[stage].find_true_s(
            [event for event in self.logs[stage] if event["event"] == kind][-1]["t_us"] * 1e-6
        )


@pytest.fixture
def rig(monkeypatch, library, chips):
    rig = MixedRig(monkeypatch, library, chips(0)).ready()
    rig.run(1.0)  # until the clocks are known
    rig.arm()
    rig.run(0.01)
    yield rig
    rig.cores[CHIP].close()


def test_two_boards_draw_a_frame_and_stop_together(rig):
    record = rig.play(build_frame(60.0, range(437), 3.0, 437))
    plan = rig.queue.state.waiting[0].planned.plan
    # As the link states it for the plan's end. It follows from stamps, which are random: an exchange may miss a turn.
    end_s = rig.clock.now_s() + 1.0
    known_s = np.array([session.clock_sync.fit(end_s).uncertainty_s for session in rig.boards.sessions])
    rig.until(lambda: record.has_ended)
    assert (record.status, record.error, record.executed_count) == ("done", None, 437)
    counts = rig.count_pulses()
    assert sum(counts) == 437
    assert min(counts) > 150
    pulses = rig.list_pulses()
    late_s = pulses[:, 0] - np.sort(record.start_s + plan.start_s)
    assert (np.abs(late_s) <= known_s[pulses[:, 4].astype(int)]).all()
    record = rig.play_trains()
    stopped_s = rig.clock.now_s()
    assert rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))["error"] is None
    assert [core.state for core in rig.cores] == ["DISARMED", "DISARMED"]
    assert [core.gate for core in rig.cores] == [False, False]
    counts = rig.count_pulses()
    rig.run(0.5)
    assert rig.count_pulses() == counts
    assert rig.list_pulses()[:, 1].max() < stopped_s + LATE_MAX_S
    assert (record.status, record.error) == ("stopped", "ended by stop")


def cut(rig, stage):
    rig.links[stage].is_cut = True


def press_emergency_stop(rig, stage):
    rig.cores[stage].set_input("estop", True, rig.links[stage]._now_us())


@pytest.mark.parametrize("lose", [cut, press_emergency_stop])
@pytest.mark.parametrize("lost", [CORE, CHIP], ids=["core", "chip"])
def test_the_loss_of_one_board_darkens_the_other_within_its_lease(rig, lost, lose):
    left = 1 - lost
    record = rig.play_trains()
    lost_s = rig.clock.now_s()
    lose(rig, lost)
    rig.run(2 * LEASE_S)
    assert [rig.cores[lost].state, rig.cores[left].state] == ["FAULT", "DISARMED"]
    assert [core.gate for core in rig.cores] == [False, False]
    assert max(rig.last_s(stage, "gate") for stage in (CORE, CHIP)) <= lost_s + LEASE_S
    assert rig.last_s(CHIP, "pin") <= lost_s + LEASE_S
    assert f"stage 's{lost}'" in (rig.remote.link_error or rig.remote.epoch_reason)
    assert record.status == "failed"
