"""Nothing that was accepted before a STOP or a disarm is lit after it, at any time of planning.

Several callers push, stream and plan dry runs with views of the epoch that may be old, while others stop, disarm, arm,
pause and resume at random times, also between the planning of a request and its commit. Nothing is lit in a pause that
was answered, and no plan is lit beyond its pulses. All parts are real; time is virtual.
"""

import random
from functools import partial
from typing import NamedTuple

import pytest

from link_service_rig import OPERATOR, WEB, ServiceRig
from optodrive.core.errors import NotReadyError, OptodriveError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.daemon.engine.plan_making import DryRunStart
from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.preview.jobs import plan_dry_run
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.planning.stimuli.pattern_registry import build_pattern
from planner_rig import DISPLAY, PlannerRig, build_frame

SEEDS = range(12)
OPERATIONS = 100
DARK_WITHIN_S = 0.004
"""Time from the end of an epoch to the end of the light: one exchange with the board."""
WEIGHTS = {
    "accept": 6,
    "deliver": 6,
    "run": 14,
    "stop": 1,
    "disarm": 1,
    "arm": 6,
    "dry_run": 1,
    "pause": 1.5,
    "resume": 6,
}


class QueuedPush(NamedTuple):
    """A request with the epoch that its caller saw when it arrived."""

    epoch: int
    sequence: FrameSequence
    streamed: bool


class Interleaving:
    """A random sequence of operations on a rig.

    answered_epoch: epoch when the latest command was answered; pushes of older ones must be refused from then on
    pauses: (board time, whether a pause lasts) at each answered pause and each end of one
    epochs: (board time, epoch) at each begin of an epoch; points: of the accepted plans
    epochs_by_duty: of the accepted plans with such a pulse
    """

    def __init__(self, monkeypatch, seed, queue_type=PlanQueue):
        self.random = random.Random(seed)
        self.rig = PlannerRig(monkeypatch, queue_type=queue_type).ready()
        self.waiting = []
        self.epochs = [(0.0, self.rig.epoch)]
        self.points, self.epochs_by_duty = [], {}
        self.rig.queue._apply = partial(self.apply, self.rig.queue._apply)
        self.pauses = [(0.0, False)]
        self.answered_epoch = 0
        self.accepted = 0
        self.serial = 0

    def play(self):
        self.arm()
        self.rig.before_loop_action = self.interfere
        for _ in range(OPERATIONS):
            (name,) = self.random.choices(list(WEIGHTS), WEIGHTS.values())
            getattr(self, name)()
        self.rig.before_loop_action = lambda: None
        for _ in range(len(self.waiting)):  # what is still on its way arrives after a last STOP and a new arming
            if not self.accepted % 2:
                self.stop()
                self.arm()
            self.deliver()
        self.resume()
        self.rig.run(0.5)
        self.check_light()
        self.check_counts()
        return self

    # --- operations

    def accept(self):
        """Accept a request. Its caller may have seen an older status of the link process."""
        self.serial += 1
        if self.random.random() < 0.3:
            sequence = build_pattern("vibration", {"height_um": 30 + self.serial, "seconds": 0.2}, DISPLAY.config)
        elif self.random.random() < 0.3:
            sequence = build_frame(150.0 + self.serial)
        else:
            power_w = 1.0 + 0.01 * self.serial  # tells the light of one push from that of another
            sequence = FrameSequence((), (PulseTrain(self.serial % 16, 0.0, 0.3, 0.005, 0.005, power_w),))
        seen = self.epochs[-1 if self.random.random() < 0.8 else self.random.randrange(len(self.epochs))][1]
        self.waiting.append(QueuedPush(seen, sequence, self.random.random() < 0.5))

    def deliver(self):
        """The planner gets a request, not always in order."""
        if not self.waiting:
            return
        push = self.waiting.pop(self.random.randrange(len(self.waiting)))
        try:
            self.rig.submit(push.sequence, push.epoch, push.streamed, lists_pulses=not push.streamed).result()
        except NotReadyError:
            return
        assert push.epoch >= self.answered_epoch, "a push of an older epoch was answered 201"
        self.accepted += 1

    def apply(self, apply, state):
        """Note the points of what the queue accepts: of pushes, of their rests, and of what they became later."""
        for plan in state.plans:
            if plan.points not in self.points:
                self.points.append(plan.points)
                for duty in plan.points.stages[0].table[:, 4].tolist():
                    self.epochs_by_duty.setdefault(duty, set()).add(plan.epoch)
        apply(state)

    def run(self):
        self.rig.run(self.random.choice((0.002, 0.1, 0.4)))

    def stop(self):
        self.command(OPERATOR, "stop")

    def disarm(self):
        self.command(WEB, "disarm")

    def arm(self):
        self.command(WEB, "arm")

    def pause(self):
        """Pause, and mostly wait for the answer. A board that is not armed refuses."""
        request = self.rig.request(WEB, "pause")
        if self.random.random() < 0.8:
            result = self.rig.await_result(WEB, request)
            self.note_epoch()
            if result["error"] is None and result["epoch"] == self.rig.epoch:
                self.pauses.append((self.rig.session.board_s(), True))

    def resume(self):
        self.note_pause_end()
        self.rig.request(WEB, "resume")

    def note_pause_end(self):
        if self.pauses[-1][1]:
            self.pauses.append((self.rig.session.board_s(), False))

    def command(self, client, kind):
        """Send a command, and mostly wait for its result."""
        request = self.rig.request(client, kind)
        self.note_epoch()
        if self.random.random() < 0.8 or kind == "arm":
            self.rig.await_result(client, request)
            ServiceRig.run(self.rig)  # the link process sends its status together with the result
            self.note_epoch()
            self.answered_epoch = self.rig.epoch

    def dry_run(self):
        """Plan without executing. The queue stays as it is."""
        snapshot = self.rig.queue.make_snapshot(False, 0.0)
        before = [record.plan_id for record in self.rig.store.list_recent()]
        sequence = build_pattern("all", {"height_um": 20}, DISPLAY.config)
        start = DryRunStart(snapshot.before, 0.1)
        assert (
            plan_dry_run(DISPLAY, self.rig.remote.scales, BuiltRequest(sequence), start, Push("dry", {}, 0.0, 0)).status
            == "planned"
        )
        assert [record.plan_id for record in self.rig.store.list_recent()] == before

    def interfere(self):
        """Act between the planning of a request and the loop's action for it."""
        if self.random.random() < 0.15:
            action = self.random.choice((self.run, self.stop, self.disarm, self.arm, self.pause, self.resume))
            self.rig.before_loop_action = lambda: None
            action()
            if self.random.random() < 0.5:
                self.arm()
            self.rig.before_loop_action = self.interfere

    # --- witness

    def note_epoch(self):
        if self.rig.epoch != self.epochs[-1][1]:
            self.epochs.append((self.rig.session.board_s(), self.rig.epoch))
            self.note_pause_end()

    def check_counts(self):
        """Compare the executed pulses of all plans with the board's log: paused or not, none is lit twice."""
        records = self.rig.store.list_recent()
        assert all(record.executed_count <= record.pulse_count for record in records)
        done = [record for record in records if record.status == "done"]
        assert all(record.executed_count + record.dropped == record.pulse_count for record in done)

    def check_light(self):
        """Compare every pulse in the board's log with the epochs of the pushes that contain such a pulse."""
        for at_s, duty in self.rig.list_emitted():
            allowed = {self.find_epoch(at_s), self.find_epoch(at_s - DARK_WITHIN_S)}
            assert self.epochs_by_duty[duty] & allowed, f"a push of an older epoch was lit at {at_s} s"
            is_paused = [lasts for since_s, lasts in self.pauses if since_s <= at_s][-1]
            assert not is_paused, f"a push was lit while the light was paused, at {at_s} s"

    def find_epoch(self, at_s):
        return [epoch for begun_s, epoch in self.epochs if begun_s <= at_s or begun_s == 0.0][-1]


@pytest.mark.parametrize("seeds", [SEEDS[8:], pytest.param(SEEDS, marks=pytest.mark.slow)], ids=["some", "all"])
def test_nothing_of_an_older_epoch_is_accepted_or_lit(monkeypatch, seeds):
    played = [Interleaving(monkeypatch, seed).play() for seed in seeds]
    assert sum(len(one.rig.list_emitted()) for one in played) > 25 * len(seeds)
    assert sum(one.accepted for one in played) > 4 * len(seeds)
    assert sum(len(one.epochs) for one in played) > 5 * len(seeds)
    assert sum(len(one.pauses) for one in played) > 4 * len(seeds)


class UncheckedQueue(PlanQueue):
    """Mutant: the commit does not check the epoch."""

    def require_epoch(self, epoch):
        """Permit every epoch."""


def test_a_commit_that_does_not_check_the_epoch_is_caught(monkeypatch):
    def play(seed):
        try:
            Interleaving(monkeypatch, seed, UncheckedQueue).play()
        except AssertionError as error:
            return str(error)
        except OptodriveError:
            return ""
        return ""

    assert any("answered 201" in play(seed) for seed in SEEDS)
